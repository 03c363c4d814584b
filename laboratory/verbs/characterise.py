"""`evstim characterise CAMERA`, by itself or beside a recording."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

from cyclopts import Parameter
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from emulator.cli.checks import failures
from emulator.cli.output import GOOD, LACKING, WRONG_USE, Failure, console, print_json, status
from emulator.report.page import ChartsLacking, check_charts
from emulator.rig.loading import RigError, load_rig
from emulator.sensor.presets import PRESETS, SensorParameters
from laboratory.characterise.measurements import figures, measurements
from laboratory.characterise.recordings import compare, write_comparison
from laboratory.characterise.report import reading, write
from laboratory.characterise.stimuli import Point


def characterise(
    camera: str = "davis346",
    /,
    *,
    out: Path,
    recording: Path | None = None,
    still: float = 0.0,
    light: float | None = None,
    fit: Annotated[bool, Parameter(negative="")] = False,
    quick: Annotated[bool, Parameter(negative="")] = False,
    json: Annotated[bool, Parameter(negative="")] = False,
) -> int:
    """Measure a simulated sensor, compare it with published values of real ones; write charts, tables and a page.

    With a recording, measure its background activity instead, and compare it with the sensor's own in still light.

    Parameters
    ----------
    camera
        Name of a preset; or path or name of a rig, whose sensor is measured.
    out
        Folder to write into; created if missing.
    recording
        Events of a real camera (.aedat4, .raw in EVT2 or EVT3, .dat, .es, .npz).
    still
        With a recording: count only pixels whose neighbours fire at this rate at most, Hz; 0: all.
    light
        With a recording: light on the whole simulated sensor. Without it the light is that of the recording's frames,
        in pixels that see no motion; 1 where it has no frames.
    fit
        With a recording: also write fit.toml, the sensor parameters that match it best.
    quick
        Fewer points.
    json
        Print one JSON object as the last line on stdout.
    """
    with failures():
        parameters = _sensor(camera)
    try:
        if recording is None:
            check_charts()
        out.mkdir(parents=True, exist_ok=True)
    except ChartsLacking as error:
        raise Failure(str(error), LACKING) from error
    except OSError as error:
        raise Failure(f"--out {out}: {error.strerror}", WRONG_USE) from error
    if recording is not None:
        return _beside(recording, (camera, parameters), out, (light, still, fit, json))
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


def _beside(
    recording: Path, sensor: tuple[str, SensorParameters], out: Path, given: tuple[float | None, float, bool, bool]
) -> int:
    """Compare a sensor, name and parameters, with a recording; `given` are light, still, fit and json."""
    light, still, fit, json = given
    with failures(), status.status("measuring ..."):
        try:
            found = compare(recording, sensor, light, still, fitted=fit)
        except ValueError as error:
            raise Failure(str(error), WRONG_USE) from error
    files = write_comparison(found, sensor[0], out)
    if json:
        print_json({"sensor": sensor[0], "recording": recording, "statistics": found.rows(), "files": files})
        return GOOD
    for line in found.reading:
        console.print(line)
    for row in found.rows():
        shown = "  ".join(f"{value:>14.4g}" for value in row.values() if isinstance(value, float))
        console.print(f"{row['statistic']!s:42}{shown}")
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
