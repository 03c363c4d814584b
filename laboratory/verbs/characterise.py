"""`evstim characterise CAMERA`, by itself or beside a recording."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from emulator.cli.checks import failures
from emulator.cli.output import GOOD, WRONG_USE, Failure, Flag, Json, print_result, status
from emulator.rig.loading import RigError, load_rig
from emulator.sensor.presets import PRESETS, SensorParameters
from laboratory.characterise.measurements import figures, measurements
from laboratory.characterise.recordings import Compared, compare, write_comparison
from laboratory.characterise.report import reading, write
from laboratory.verbs import check_drawing, collected, make_folder


def characterise(
    camera: str = "davis346",
    /,
    *,
    out: Path,
    recording: Path | None = None,
    still: float | None = None,
    light: float | None = None,
    fit: Flag = False,
    quick: Flag = False,
    json: Json = False,
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
        Events of a real camera, in any format that is read: see docs/recordings.md.
    still
        With a recording: count only pixels whose neighbours fire at this rate at most, Hz; without it, or 0: all.
    light
        With a recording: light on the whole simulated sensor. Without it the light is that of the recording's frames,
        in pixels that see no motion; 1 where it has no frames.
    fit
        With a recording: also write fit.toml, the sensor parameters that match it best.
    quick
        Fewer points.
    """
    with failures():
        parameters = _sensor(camera)
    if recording is None:
        values = {"--still": still, "--light": light, "--fit": fit or None}
        if options := " and ".join(name for name, value in values.items() if value is not None):
            raise Failure(f"{options}: only beside a recording: name it by --recording, or leave it out", WRONG_USE)
        check_drawing()
    make_folder(out)
    if recording is not None:
        with failures(), status.status("measuring ..."):
            try:
                comparison = compare(recording, (camera, parameters), light, still or 0.0, fitted=fit)
            except ValueError as error:
                raise Failure(str(error), WRONG_USE) from error
        return _show(comparison, camera, recording, write_comparison(comparison, camera, out), json=json)
    todo = measurements(parameters, quick)
    points = [
        point for measured in collected((measure() for measure in todo), len(todo), "measuring") for point in measured
    ]
    points += figures(points)
    with status.status("drawing ..."):
        files = write(points, camera, out)
    print_result(json, {"sensor": camera, "files": files}, [*reading(points, camera)[1:], *map(str, files)])
    return GOOD


def _show(comparison: Compared, camera: str, recording: Path, files: Sequence[Path], *, json: bool) -> int:
    """Print the comparison of a sensor with a recording."""
    rows, widths = comparison.rows(), {name: max(14, len(name)) for name in comparison.streams}
    lines = [
        *comparison.reading,
        "  ".join([f"{'statistic':40}", *(f"{name:>{width}}" for name, width in widths.items())]),
    ]
    for row in rows:
        shown = "  ".join(f"{row[name]:>{width}.4g}" for name, width in widths.items())
        lines.append(f"{row['statistic']!s:42}{shown}")
    value = {"sensor": camera, "recording": recording, "statistics": rows, "files": files}
    print_result(json, value, [*lines, *map(str, files)])
    return GOOD


def _sensor(camera: str) -> SensorParameters:
    if camera in PRESETS:
        return PRESETS[camera]
    try:
        return load_rig(camera).camera.sensor
    except RigError as error:
        known = ", ".join(PRESETS)
        raise RigError(f"{camera!r} is no preset ({known}) and no rig: {error}") from error
