"""CCSDS orbit and attitude files in keyword notation: OEM (502.0-B) and AEM (504.0-B), as far as a scene needs them.

OEM, after its header and metadata (META_START ... META_STOP), one line a sample, km and km/s:

    epoch  X Y Z  [X_DOT Y_DOT Z_DOT  [accelerations, ignored]]

AEM, likewise, with ATTITUDE_TYPE = QUATERNION, one line a sample:

    epoch  Q1 Q2 Q3 QC        (QUATERNION_TYPE = LAST, the default here and in version 2, where the keyword is gone)
    epoch  QC Q1 Q2 Q3        (QUATERNION_TYPE = FIRST)

Segments follow one another without gaps; at an epoch that two share the later one holds, and nothing is interpolated
across it. Only the part between USEABLE_START_TIME and USEABLE_STOP_TIME is used. INTERPOLATION with its degree is done
as asked (LINEAR, LAGRANGE, HERMITE); without it places lie on cubic Hermite curves. Attitudes lie on a spline of
rotations whatever INTERPOLATION_METHOD says, which is noted. REF_FRAME, CENTER_NAME and TIME_SYSTEM must be the same in
all segments of a file. For frames of attitudes see `frames`, for times `epochs`.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.trajectory.epochs import epoch_ns, scale_of
from emulator.trajectory.frames import axes_of, world_is_a
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.polynomial import PolynomialPath
from emulator.trajectory.pose import FARTHEST_M, STILL, Pose, Trajectory, TrajectoryError
from emulator.trajectory.segments import Segment, Segmented

__all__ = ["CcsdsPath", "parse_aem", "parse_oem"]

_KEYWORD = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*(.*)$")
_MARKS = re.compile(r"(META|DATA|COVARIANCE)_(START|STOP)$")
_SAME = ("REF_FRAME", "REF_FRAME_A", "REF_FRAME_B", "CENTER_NAME", "TIME_SYSTEM")
_INTERPOLATIONS = ("", "LINEAR", "LAGRANGE", "HERMITE")

_Floats = npt.NDArray[np.float64]
_Line = tuple[int, dict[str, str], list[str]]


@dataclass(frozen=True, eq=False)
class CcsdsPath:
    """Contents of a CCSDS file.

    Attributes
    ----------
    path : on the file's own time axis, ns since 2000 on `scale`, see `epochs`.
    scale : "TAI" where times can be compared with other files, else the file's own TIME_SYSTEM.
    axes : the frame of the world, the same text for frames whose axes are the same; empty where the file names none.
    notes : what was not done as the file asks.
    """

    path: Segmented
    scale: str
    axes: str
    notes: tuple[str, ...] = ()


@dataclass(eq=False)
class _Samples:
    """The lines of one segment: epochs, numbers, and the metadata above them."""

    meta: dict[str, str]
    line: int
    times_ns: list[int] = field(default_factory=list)
    values: list[_Floats] = field(default_factory=list)

    @property
    def time_system(self) -> str:
        return self.meta.get("TIME_SYSTEM", "UTC").upper()

    def since_first_ns(self) -> list[int]:
        return [t - self.times_ns[0] for t in self.times_ns]

    def segment(self, path: Trajectory) -> Segment:
        start, stop = self.times_ns[0], self.times_ns[-1]
        if text := self.meta.get("USEABLE_START_TIME"):
            start = max(start, epoch_ns(text, self.time_system))
        if text := self.meta.get("USEABLE_STOP_TIME"):
            stop = min(stop, epoch_ns(text, self.time_system))
        if stop < start:
            raise ValueError("no sample lies between USEABLE_START_TIME and USEABLE_STOP_TIME")
        return Segment(path, self.times_ns[0], start, stop)


def parse_oem(text: str) -> CcsdsPath:
    """Read an orbit file: places in metres, attitudes those of the world; raises TrajectoryError with the line."""
    return _parse(text, _place, _places)


def parse_aem(text: str) -> CcsdsPath:
    """Read an attitude file: attitudes at the origin; raises TrajectoryError with the line."""
    return _parse(text, _world_from_body, _attitudes)


def _parse(
    text: str,
    read: Callable[[dict[str, str], list[str]], _Floats],
    build: Callable[[_Samples], Trajectory],
) -> CcsdsPath:
    segments = list(_segments(text, read))
    if not segments:
        raise TrajectoryError("an empty trajectory: the file holds no samples")
    _require_same(segments)
    built = []
    for samples in segments:
        try:
            built.append(samples.segment(build(samples)))
        except (TrajectoryError, ValueError) as error:
            raise TrajectoryError(f"segment at line {samples.line}: {error}") from error
    meta = segments[0].meta
    frame = meta.get("REF_FRAME") or meta.get("REF_FRAME_A" if _a_is_world(meta) else "REF_FRAME_B", "")
    methods = sorted({s.meta["INTERPOLATION_METHOD"] for s in segments if "INTERPOLATION_METHOD" in s.meta})
    notes = tuple(f"INTERPOLATION_METHOD {m}: attitudes lie on a spline of rotations instead" for m in methods)
    return CcsdsPath(Segmented(built), scale_of(segments[0].time_system), axes_of(frame), notes)


def _segments(text: str, read: Callable[[dict[str, str], list[str]], _Floats]) -> Iterator[_Samples]:
    samples: _Samples | None = None
    for number, meta, cells in _data_lines(text):
        if samples is None or samples.meta is not meta:
            if samples is not None:
                yield samples
            samples = _Samples(meta, number)
        try:
            samples.times_ns.append(epoch_ns(cells[0], samples.time_system))
            samples.values.append(read(meta, cells[1:]))
        except ValueError as error:
            raise TrajectoryError(f"line {number}: {error}") from error
    if samples is not None:
        yield samples


def _data_lines(text: str) -> Iterator[_Line]:
    """Yield the number, the segment's metadata and the cells of each data line."""
    meta: dict[str, str] = {}
    inside = ""
    for number, raw in enumerate(text.splitlines(), start=1):
        line = raw.strip()
        if mark := _MARKS.match(line):
            inside = mark.group(1) if mark.group(2) == "START" else ""
            meta = {} if line == "META_START" else meta
        elif keyword := _KEYWORD.match(line):
            meta[keyword.group(1)] = keyword.group(2).strip()
        elif line and not line.startswith("COMMENT") and inside in ("", "DATA"):
            yield number, meta, line.split()


def _require_same(segments: list[_Samples]) -> None:
    for samples in segments[1:]:
        for name in _SAME:
            first, here = (s.meta.get(name, "missing") for s in (segments[0], samples))
            if first != here:
                raise TrajectoryError(
                    f"segment at line {samples.line}: {name} is {here}, and {first} in the first segment: "
                    "convert the file to one"
                )


def _place(_: dict[str, str], cells: list[str]) -> _Floats:
    values = np.array([float(cell) for cell in cells])
    if len(values) not in (3, 6, 9):
        raise ValueError(f"an epoch and 3, 6 or 9 numbers are expected, got {len(values)}")
    if not (np.abs(values) <= FARTHEST_M / 1000).all():
        raise ValueError(f"numbers must be finite, at most {FARTHEST_M / 1000:g} km or km/s, got {' '.join(cells)}")
    return values * 1000.0


def _places(samples: _Samples) -> Trajectory:
    """Return the path of one segment on the curves that it asks for."""
    kind = samples.meta.get("INTERPOLATION", "").upper()
    if kind not in _INTERPOLATIONS:
        raise TrajectoryError(f"INTERPOLATION = {kind}: one of LINEAR, LAGRANGE and HERMITE is known")
    places = np.array([values[:3] for values in samples.values])
    has_velocities = min(len(values) for values in samples.values) >= 6
    velocities = np.array([values[3:6] for values in samples.values]) if has_velocities else None
    if not kind:
        # a spline through places is better than velocities for some of them
        return Keyframes(samples.since_first_ns(), [Pose(p, STILL.q_world_from_body) for p in places], velocities)
    if kind == "HERMITE" and velocities is None:
        raise TrajectoryError("INTERPOLATION = HERMITE needs velocities in all lines")
    degree = 1 if kind == "LINEAR" else _degree(samples.meta)
    return PolynomialPath(samples.since_first_ns(), places, degree, velocities if kind == "HERMITE" else None)


def _degree(meta: dict[str, str]) -> int:
    text = meta.get("INTERPOLATION_DEGREE", "")
    if not text.isdecimal():
        raise TrajectoryError(f"INTERPOLATION = {meta['INTERPOLATION']} needs INTERPOLATION_DEGREE, a whole number")
    return int(text)


def _a_is_world(meta: dict[str, str]) -> bool:
    return "REF_FRAME_A" in meta and world_is_a(meta["REF_FRAME_A"], meta.get("REF_FRAME_B", ""))


def _world_from_body(meta: dict[str, str], cells: list[str]) -> _Floats:
    """Return the unit quaternion of one line, scalar first.

    A CCSDS quaternion turns coordinates: with ATTITUDE_DIR = A2B (the default) it is B from A, with B2A it is A from B.
    In components, `B from A` turns coordinates; the turn that takes A's axes into B's is world from body where A is the
    world, and has the same four numbers.
    """
    if meta.get("ATTITUDE_TYPE", "QUATERNION") != "QUATERNION":
        raise ValueError(f"ATTITUDE_TYPE {meta['ATTITUDE_TYPE']} is not read; convert it to QUATERNION")
    if len(cells) < 4:
        raise ValueError(f"an epoch and four components are expected, got {len(cells)}")
    q = np.array([float(cell) for cell in cells[:4]])
    if meta.get("QUATERNION_TYPE", "LAST") == "LAST":
        q = np.roll(q, 1)
    is_b_from_a = meta.get("ATTITUDE_DIR", "A2B") == "A2B"
    is_same = world_is_a(meta.get("REF_FRAME_A", ""), meta.get("REF_FRAME_B", "")) == is_b_from_a
    return Pose(np.zeros(3), q if is_same else q * np.array([1.0, -1.0, -1.0, -1.0])).q_world_from_body


def _attitudes(samples: _Samples) -> Trajectory:
    return Keyframes(samples.since_first_ns(), [Pose(np.zeros(3), q) for q in samples.values])
