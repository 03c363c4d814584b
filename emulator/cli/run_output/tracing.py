"""The files of `evstim run --trace`."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from emulator.cli.output import WRONG_USE, Failure
from emulator.cli.output_paths import check_output
from emulator.run.tracing import traced
from transports.link.process import LinkSetup
from transports.usb.usbip.trace_paths import both_files

__all__ = ["begin_trace"]


def begin_trace(setups: Sequence[LinkSetup[Any]], path: Path | None) -> list[LinkSetup[Any]]:
    """Return the links, with a trace of their USB cables in new files; raises Failure."""
    links, traces = traced(setups, path)
    if path is not None and not traces:
        raise Failure("--trace: this rig has no link of kind usbip, so there is no USB cable to trace", WRONG_USE)
    for file in [file for trace in traces for file in both_files(trace)]:
        check_output("--trace", file)
        if file.is_file():
            file.write_bytes(b"")
    return links
