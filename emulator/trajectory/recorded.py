"""Trajectories from files, one for the places and perhaps one for the attitudes, each at its own times.

Time 0 is the first place. Attitudes are taken at the epochs of their own file (CCSDS AEM); beside a table or a flight
file, which have no epochs, they begin at time 0.
"""

from __future__ import annotations

import logging
from pathlib import Path

from emulator.tables.text_file import TextFileError, read_text, shortened
from emulator.trajectory.ccsds_file import CcsdsPath, parse_aem, parse_oem
from emulator.trajectory.composed import Mounted, PlaceAndAttitude
from emulator.trajectory.conventions import OPENGL_FROM_CAMERA
from emulator.trajectory.flight_file import parse_flight
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.parameters import FilePath
from emulator.trajectory.pose import Trajectory, TrajectoryError
from emulator.trajectory.table_file import Samples, parse_table

__all__ = ["read_path"]

_MOST_BYTES = 1 << 28
_LOG = logging.getLogger(__name__)

_Span = tuple[int, int]


def read_path(p: FilePath) -> tuple[Trajectory, _Span]:
    """Return the path of the files that a rig names, and its first and last time; raises TrajectoryError."""
    path = Path(p.path)
    try:
        orbit = parse_oem(_text(path)) if path.suffix.lower() == ".oem" else None
        places = orbit.path if orbit else _keyframes(path, p.period_s)
    except TrajectoryError as error:
        raise TrajectoryError(f"{p.path}: {shortened(error)}") from error
    start_ns, stop_ns = places.span_ns
    zero_ns = start_ns if orbit else 0
    try:
        attitudes, attitudes_zero_ns = _attitudes(p, places.span_ns, orbit) if p.attitude_path else (places, zero_ns)
    except TrajectoryError as error:
        raise TrajectoryError(f"{p.attitude_path}: {shortened(error)}") from error
    both: Trajectory = PlaceAndAttitude(places, attitudes, zero_ns, attitudes_zero_ns)
    return Mounted(both, OPENGL_FROM_CAMERA) if p.axes == "opengl" else both, (start_ns - zero_ns, stop_ns - zero_ns)


def _keyframes(path: Path, period_s: float) -> Keyframes:
    samples = _samples(path, period_s)
    return Keyframes(samples.times_ns, samples.poses)


def _samples(path: Path, period_s: float) -> Samples:
    match path.suffix.lower():
        case ".fli":
            flight = parse_flight(_text(path), period_s)
            if flight.left_out:
                told = ", ".join(f"{count} {command}" for command, count in flight.left_out.items())
                _LOG.info("%s: left out of the flight: %s", path, told)
            return flight.samples
        case ".csv":
            return parse_table(_text(path))
    raise TrajectoryError("which format this is cannot be told: name it .csv, .oem or .fli")


def _attitudes(p: FilePath, span_ns: _Span, orbit: CcsdsPath | None) -> tuple[Trajectory, int]:
    """Return the attitudes, and the time on their axis that is time 0 of the path."""
    file = parse_aem(_text(Path(p.attitude_path)))
    for note in file.notes:
        _LOG.info("%s: %s", p.attitude_path, note)
    if orbit is None:
        return file.path, file.path.span_ns[0]
    _require_comparable(orbit, file)
    late_s, early_s = (file.path.span_ns[0] - span_ns[0]) * 1e-9, (span_ns[1] - file.path.span_ns[1]) * 1e-9
    length_s = (span_ns[1] - span_ns[0]) * 1e-9
    if max(late_s, early_s) > length_s:
        raise TrajectoryError("the attitudes are of another time than the places: they do not overlap")
    if max(late_s, early_s) > 0:
        gaps = f"{max(late_s, 0):g} s at the beginning and {max(early_s, 0):g} s at the end"
        _LOG.warning("%s: no attitudes for %s of the path: the nearest one holds there", p.attitude_path, gaps)
    return file.path, span_ns[0]


def _require_comparable(orbit: CcsdsPath, attitudes: CcsdsPath) -> None:
    for what, of_orbit, of_attitudes in (
        ("TIME_SYSTEM", orbit.scale, attitudes.scale),
        ("reference frame", orbit.axes, attitudes.axes),
    ):
        if of_orbit and of_attitudes and of_orbit != of_attitudes:
            raise TrajectoryError(
                f"its {what} is {of_attitudes}, and that of the orbit file {of_orbit}: convert one of them"
            )


def _text(path: Path) -> str:
    try:
        return read_text(path, _MOST_BYTES)
    except TextFileError as error:
        raise TrajectoryError(str(error)) from error
