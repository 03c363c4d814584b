"""`evstim characterise CAMERA`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.characterise.measurements import figures, measurements
from emulator.characterise.points import Point
from emulator.characterise.report import reading, write
from emulator.cli.failures import failures
from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from emulator.report.figures import ChartsLacking, check
from emulator.rig.loading import RigError, load_rig
from emulator.sensor.presets import PRESETS, SensorParameters

__all__ = ["characterise"]


def characterise(
    camera: str = "davis346",
    /,
    *,
    out: Path,
    quick: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Measure a simulated sensor, compare it with published figures of real ones; write charts, tables and a page.

    Parameters
    ----------
    camera
        Name of a preset; or path or name of a rig, whose sensor is measured.
    out
        Folder to write into; created if missing.
    quick
        Fewer points.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        parameters = _sensor(camera)
    try:
        check()
        out.mkdir(parents=True, exist_ok=True)
    except ChartsLacking as error:
        raise Failure(str(error), LACKING) from error
    except OSError as error:
        raise Failure(f"--out {out}: {error.strerror}", WRONG_USE) from error
    points = _measure(parameters, quick)
    with status.status("drawing ..."):
        files = write(points, camera, out)
    if json:
        print_json({"sensor": camera, "files": files})
    else:
        for line in reading(points, camera)[1:]:
            console.print(line)
        for path in files:
            console.print(str(path))
    return GOOD


def _sensor(camera: str) -> SensorParameters:
    if camera in PRESETS:
        return PRESETS[camera]
    try:
        return load_rig(camera).camera.sensor
    except RigError as error:
        raise RigError(f"{camera!r} is no preset ({', '.join(PRESETS)}) and no rig: {error}") from error


def _measure(parameters: SensorParameters, quick: bool) -> list[Point]:
    """Measure everything under a progress bar."""
    columns = TextColumn("{task.description}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    todo = measurements(parameters, quick)
    with Progress(*columns, console=status, transient=True) as progress:
        points = [point for measure in progress.track(todo, description="measuring") for point in measure()]
    return [*points, *figures(points)]
