"""`evstim info` of a truth file."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from emulator.cli.output import BAD_VERDICT, GOOD, console, print_json

__all__ = ["show_truth"]


def show_truth(file: Path, told: Mapping[str, Any], *, json: bool) -> int:
    """Print what `truth_in` told of a file; return the exit code."""
    if json:
        print_json({"file": file, **told})
    else:
        for line in _lines(told):
            console.print(line, markup=False)
    return GOOD if told["complete"] else BAD_VERDICT


def _lines(told: Mapping[str, Any]) -> list[str]:
    names = ", ".join(f"{k} {name}" for k, name in enumerate(told["names"]))
    origins = ", ".join(f"{count} {name}" for name, count in told["origins"].items())
    lines = [
        f"format    {told['format']}, version {told['version']}: HDF5 (opens in h5py; see docs/truth.md)",
        f"of        {told['rig']}: {told['title']}; {told['camera']}, {told['width']} x {told['height']} pixels",
        f"pictures  {told['pictures']} in {told['seconds']:.3f} s, each with {', '.join(told['of_each_picture'])}",
        f"poses     {told['poses']}",
        f"labels    {names}",
        f"events    {told['events']}{': ' + origins if origins else ''}",
        f"clean     {told['clean_events']} events of the ideal sensor",
    ]
    lines += [f"absent    {told['absent']}"] if told["absent"] else []
    if told["missing_pictures"] or told["missing_events"]:
        lost = f"{told['missing_pictures']} pictures and {told['missing_events']} events"
        lines.append(f"NOTE      it lacks {lost}, which came faster than they could be written")
    elif not told["complete"]:
        lines.append("NOTE      it was not finished: the process that wrote it was killed, or the disk was full")
    return lines
