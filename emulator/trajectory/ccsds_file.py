"""CCSDS orbit and attitude files in keyword notation: OEM (502.0-B) and AEM (504.0-B), as far as a scene needs them.

OEM, after its header and metadata (META_START ... META_STOP), one line a sample, km and km/s:

    epoch  X Y Z  [X_DOT Y_DOT Z_DOT  [accelerations, ignored]]

AEM, likewise, with ATTITUDE_TYPE = QUATERNION, one line a sample:

    epoch  Q1 Q2 Q3 QC        (QUATERNION_TYPE = LAST, the default here and in version 2, where the keyword is gone)
    epoch  QC Q1 Q2 Q3        (QUATERNION_TYPE = FIRST)

Segments follow one another without gaps; at an epoch that two share the later one holds, and nothing is interpolated
across it. Only the part between USEABLE_START_TIME and USEABLE_STOP_TIME is used. INTERPOLATION with its degree is
applied (LINEAR, LAGRANGE, HERMITE); without it places lie on cubic Hermite curves. Attitudes always lie on a spline of
rotations; another INTERPOLATION_METHOD is noted. REF_FRAME, CENTER_NAME and TIME_SYSTEM must be the same in
all segments of a file. For frames of attitudes see `frames`, for times `epochs`.

Epochs are nanoseconds of one continuous time scale:

    UTC                 leap seconds are counted: 23:59:60 is an instant, and a file may cross one
    TAI, TT (TDT), GPS  TAI = TT - 32.184 s = GPS + 19 s
    TDB                 taken as TT, from which it never differs by more than 2 ms
    others              (UT1, MET, MRT, SCLK, TCB, TCG, GMST) have no fixed relation to these: they are only compared
                        with themselves

Source of the leap seconds: IERS Bulletin C; the last one was at the end of 2016. Before 1972 UTC is taken as TAI less
10 s.

A reference frame stands for the world when its axes are those of the sky or of a planet. Names are compared without
case, spaces, hyphens and underscores. Source: the SANA registry of celestial body reference frames, and SPICE's names
(J2000, IAU_*). Axes of ICRF, GCRF, EME2000 and J2000 differ by less than 0.1 seconds of arc and count as the same.

Places lie on polynomials through the nearest samples:

    Lagrange of degree d     through d + 1 samples
    Hermite of degree d      through (d + 1) / 2 samples and their velocities; an even degree is raised by one

The samples lie evenly before and after the instant, an odd one before it; at the ends of the path they are the first or
last ones. One polynomial follows another at a sample, which both go through, so the place makes no jump. Computed
by scipy's KroghInterpolator (Krogh 1970, Mathematics of Computation 24, 185) in steps of time, which keeps it well
conditioned.
"""

from __future__ import annotations

import itertools
import re
from bisect import bisect_right
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import date, datetime, timedelta
from fractions import Fraction
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.pose import (
    AT_REST,
    FARTHEST_M,
    STILL,
    Bounds,
    Motion,
    Pose,
    Trajectory,
    TrajectoryError,
    instants_between,
    measured_bounds,
    require_increasing,
)
from firmware_protocol.events import Floats

if TYPE_CHECKING:
    from scipy.interpolate import KroghInterpolator


_EPOCH = re.compile(r"(\d{4})-(?:(\d{3})|(\d{2})-(\d{2}))T(\d{2}):(\d{2}):(\d{2})(\.\d+)?Z?$")
_ORIGIN = datetime(2000, 1, 1)
_BEHIND_TAI_NS = {"TAI": 0, "TT": -32_184_000_000, "TDT": -32_184_000_000, "TDB": -32_184_000_000, "GPS": 19 * 10**9}
_FIRST_OFFSET_S = 10
_LEAPS = [
    date(year, month, 1)
    for year, month in (
        (1972, 7), (1973, 1), (1974, 1), (1975, 1), (1976, 1), (1977, 1), (1978, 1), (1979, 1), (1980, 1), (1981, 7),
        (1982, 7), (1983, 7), (1985, 7), (1988, 1), (1990, 1), (1991, 1), (1992, 7), (1993, 7), (1994, 7), (1996, 1),
        (1997, 7), (1999, 1), (2006, 1), (2009, 1), (2012, 7), (2015, 7), (2017, 1),
    )
]  # fmt: skip
"""Days that begin just after a leap second."""


def epoch_ns(text: str, time_system: str = "UTC") -> int:
    """Return an epoch on the scale of its time system, ns since 2000-01-01T00:00:00 of that; raises ValueError."""
    match = _EPOCH.match(text)
    if not match:
        raise ValueError(f"epoch {text!r}: expected yyyy-mm-ddThh:mm:ss or yyyy-dddThh:mm:ss")
    year, day_of_year, month, day, hour, minute, second, fraction = match.groups()
    start = datetime(int(year), int(month or 1), int(day or 1), int(hour), int(minute))
    if day_of_year:
        start += timedelta(days=int(day_of_year) - 1)
    if int(second) >= 60:
        after = start + timedelta(minutes=1)
        is_last_minute = (start.hour, start.minute) == (23, 59)
        if time_system != "UTC" or int(second) > 60 or not is_last_minute or after.date() not in _LEAPS:
            raise ValueError(f"epoch {text!r}: there was no leap second in {time_system}")
    seconds = (start - _ORIGIN) // timedelta(seconds=1) + int(second)
    ns = seconds * 10**9 + int(Fraction(fraction or "0") * 10**9)
    if time_system == "UTC":
        return ns + (_FIRST_OFFSET_S + bisect_right(_LEAPS, start.date())) * 10**9
    return ns + _BEHIND_TAI_NS.get(time_system, 0)


_CELESTIAL = re.compile(
    r"(ICRF|MCI|B1950|FK[45]|TEME(OFDATE|OFEPOCH)?|TOD|MOD|MOE|TOE|TOR|TRUEECLIPTIC|"
    r"(MEAN)?ECLIPTIC(J2000)?|ECLIPJ2000|J2000ECLIPTIC|ALIGN(CB|EARTH)|UVWGOINERTIAL|GALACTIC|"
    r"ITRF\d*|DTRF\d*|CIRS|TIRS|GTOD|TDR|PEF|EFG|WGS84|FIXED(CB|EARTH)|MOON(ME|MEIAU|PA).*|IAU.+)$"
)
_SAME_AXES = re.compile(r"(ICRF\d*|GCRF\d*|EME2000|J2000)$")


def axes_of(frame: str) -> str:
    """Return a text that is the same for frames of the same axes; empty for no name."""
    name = re.sub(r"[\s_-]", "", frame.upper())
    return "ICRF" if _SAME_AXES.match(name) else name


def world_is_a(frame_a: str, frame_b: str) -> bool:
    """Return whether the first of two frames stands for the world, and not the second; raises ValueError otherwise."""
    is_world = [bool(_CELESTIAL.match(axes_of(frame))) for frame in (frame_a, frame_b)]
    if is_world[0] == is_world[1]:
        problem = "both are" if is_world[0] else "neither is"
        raise ValueError(
            f"REF_FRAME_A = {frame_a or 'missing'}, REF_FRAME_B = {frame_b or 'missing'}: one must be the world's "
            f"frame (ICRF, EME2000, MCI, IAU_EROS, ...) and the other the spacecraft's; {problem} known as the world's"
        )
    return is_world[0]


_HIGHEST_DEGREE = 25


class PolynomialPath(Trajectory):
    """A path through places at given times on polynomials, with the attitude of the world.

    Raises TrajectoryError for times that do not increase, or too few samples for the degree.

    Parameters
    ----------
    times_ns : (n,) increasing.
    places_m : (n, 3).
    degree : of the polynomials.
    velocities_m_s : (n, 3) for Hermite's, None for Lagrange's.
    """

    def __init__(
        self, times_ns: Sequence[int], places_m: npt.ArrayLike, degree: int, velocities_m_s: npt.ArrayLike | None = None
    ) -> None:
        self._places_m = np.asarray(places_m, np.float64)
        self._velocities = None if velocities_m_s is None else np.asarray(velocities_m_s, np.float64)
        require_increasing(times_ns, len(self._places_m))
        self._times_ns = np.array(times_ns, np.int64)
        self.span_ns = int(times_ns[0]), int(times_ns[-1])
        self._used = degree + 1 if velocities_m_s is None else degree // 2 + 1
        if not 1 <= degree <= _HIGHEST_DEGREE:
            raise TrajectoryError(f"a degree of {degree}: 1 to {_HIGHEST_DEGREE} can be used")
        if len(times_ns) < self._used:
            raise TrajectoryError(f"degree {degree} needs {self._used} samples, and there are {len(times_ns)}")
        self._at: tuple[int, KroghInterpolator] | None = None

    def pose(self, t_ns: int) -> Pose:
        """Return the place at `t_ns`; before the first sample and after the last it stays."""
        t_ns = min(max(int(t_ns), self.span_ns[0]), self.span_ns[1])
        first, curve = self._curve(t_ns)
        return Pose(curve(self._steps(first, t_ns)), STILL.q_world_from_body)

    def motion(self, t_ns: int) -> Motion:
        """Return the polynomial's derivatives at `t_ns`; it rests outside its span."""
        if not self.span_ns[0] <= t_ns < self.span_ns[1]:
            return AT_REST
        first, curve = self._curve(t_ns)
        _, slope, bend = curve.derivatives(self._steps(first, t_ns), der=3)
        step_s = self._step_ns(first) * 1e-9
        return Motion(slope / step_s, bend / step_s**2, np.zeros(3))

    def _curve(self, t_ns: int) -> tuple[int, KroghInterpolator]:
        """Return the polynomial around `t_ns`, and the first sample that it goes through."""
        after = int(np.searchsorted(self._times_ns, t_ns, "right"))
        first = min(max(after - (self._used + 1) // 2, 0), len(self._times_ns) - self._used)  # of the samples around it
        if self._at is None or self._at[0] != first:
            self._at = first, self._through(first)
        return self._at

    @cached_property
    def bounds(self) -> Bounds:
        """Measured bounds; it does not turn."""
        return measured_bounds(self.pose, instants_between(self._times_ns))

    def _through(self, first: int) -> KroghInterpolator:
        # Loaded where it is used: it takes longer than the rest of a short run's imports.
        from scipy.interpolate import KroghInterpolator

        used = slice(first, first + self._used)
        steps = (self._times_ns[used] - self._times_ns[first]) / self._step_ns(first)
        if self._velocities is None:
            return KroghInterpolator(steps, self._places_m[used])
        pairs = np.stack([self._places_m[used], self._velocities[used] * self._step_ns(first) * 1e-9], axis=1)
        return KroghInterpolator(np.repeat(steps, 2), pairs.reshape(-1, 3))

    def _steps(self, first: int, t_ns: int) -> float:
        return (t_ns - int(self._times_ns[first])) / self._step_ns(first)

    def _step_ns(self, first: int) -> float:
        return (int(self._times_ns[first + self._used - 1]) - int(self._times_ns[first])) / (self._used - 1 or 1) or 1.0


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of a trajectory.

    Attributes
    ----------
    path : on a time axis of its own.
    zero_ns : the instant of the whole's time axis at which the path's time is 0.
    start_ns, stop_ns : when the path may be used, on the whole's time axis.
    """

    path: Trajectory
    zero_ns: int
    start_ns: int
    stop_ns: int


class Segmented(Trajectory):
    """A trajectory of segments in turn; at an instant that two share the later one holds.

    Before the first segment and after the last the pose is constant. Raises TrajectoryError for segments that overlap
    or leave a gap.
    """

    def __init__(self, segments: Sequence[Segment]) -> None:
        for number, (a, b) in enumerate(itertools.pairwise(segments), start=2):
            if b.start_ns != a.stop_ns:
                apart_s = (b.start_ns - a.stop_ns) * 1e-9
                problem = f"starts {apart_s:g} s after" if apart_s > 0 else f"starts {-apart_s:g} s before"
                raise TrajectoryError(f"segment {number} {problem} the end of the one before: they must follow closely")
        self._segments = tuple(segments)
        self.span_ns = segments[0].start_ns, segments[-1].stop_ns
        self._starts_ns = [segment.start_ns for segment in segments]

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`."""
        segment = self._segment(t_ns)
        return segment.path.pose(min(max(t_ns, segment.start_ns), segment.stop_ns) - segment.zero_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion of the segment at `t_ns`."""
        segment = self._segment(t_ns)
        return segment.path.motion(min(max(t_ns, segment.start_ns), segment.stop_ns) - segment.zero_ns)

    def _segment(self, t_ns: int) -> Segment:
        return self._segments[max(0, bisect_right(self._starts_ns, t_ns) - 1)]

    @cached_property
    def bounds(self) -> Bounds:
        """The greatest of the segments; jumps from one to the next are left out."""
        speeds_m_s, turns_rad_s = zip(*(segment.path.bounds for segment in self._segments), strict=True)
        return Bounds(max(speeds_m_s), max(turns_rad_s))


_KEYWORD = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*(.*)$")
_MARKS = re.compile(r"(META|DATA|COVARIANCE)_(START|STOP)$")
_SAME = ("REF_FRAME", "REF_FRAME_A", "REF_FRAME_B", "CENTER_NAME", "TIME_SYSTEM")
_INTERPOLATIONS = ("", "LINEAR", "LAGRANGE", "HERMITE")


@dataclass(frozen=True, eq=False)
class CcsdsPath:
    """Contents of a CCSDS file.

    Attributes
    ----------
    path : on the file's own time axis, ns since 2000 on `scale`, see `epochs`.
    scale : "TAI" where times can be compared with other files, else the file's own TIME_SYSTEM.
    axes : the frame of the world, the same text for frames whose axes are the same; empty where the file names none.
    notes : requests of the file that were not followed.
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
    values: list[Floats] = field(default_factory=list)

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
    text: str, read: Callable[[dict[str, str], list[str]], Floats], build: Callable[[_Samples], Trajectory]
) -> CcsdsPath:
    segments = _segments(text, read)
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
    a_is_world = "REF_FRAME_A" in meta and world_is_a(meta["REF_FRAME_A"], meta.get("REF_FRAME_B", ""))
    frame = meta.get("REF_FRAME") or meta.get("REF_FRAME_A" if a_is_world else "REF_FRAME_B", "")
    methods = sorted({s.meta["INTERPOLATION_METHOD"] for s in segments if "INTERPOLATION_METHOD" in s.meta})
    notes = tuple(f"INTERPOLATION_METHOD {m}: attitudes lie on a spline of rotations instead" for m in methods)
    scale = segments[0].time_system
    scale = "TAI" if scale == "UTC" or scale in _BEHIND_TAI_NS else scale
    return CcsdsPath(Segmented(built), scale, axes_of(frame), notes)


def _segments(text: str, read: Callable[[dict[str, str], list[str]], Floats]) -> list[_Samples]:
    """Return the segments that have data lines; raises TrajectoryError with the line."""
    segments: list[_Samples] = []
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
            if not segments or segments[-1].meta is not meta:
                segments.append(_Samples(meta, number))
            epoch, *cells = line.split()
            try:
                segments[-1].times_ns.append(epoch_ns(epoch, segments[-1].time_system))
                segments[-1].values.append(read(meta, cells))
            except ValueError as error:
                raise TrajectoryError(f"line {number}: {error}") from error
    return segments


def _require_same(segments: list[_Samples]) -> None:
    for samples in segments[1:]:
        for name in _SAME:
            first, later = (s.meta.get(name, "missing") for s in (segments[0], samples))
            if first != later:
                raise TrajectoryError(
                    f"segment at line {samples.line}: {name} is {later}, and {first} in the first segment: "
                    "convert the file to one"
                )


def _place(_: dict[str, str], cells: list[str]) -> Floats:
    values = np.array([float(cell) for cell in cells])
    if len(values) not in (3, 6, 9):
        raise ValueError(f"an epoch and 3, 6 or 9 numbers are expected, got {len(values)}")
    if not (np.abs(values) <= FARTHEST_M / 1000).all():
        raise ValueError(f"numbers must be finite, at most {FARTHEST_M / 1000:g} km or km/s, got {' '.join(cells)}")
    return values * 1000.0


def _places(samples: _Samples) -> Trajectory:
    """Return the path of one segment on its interpolation curves."""
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
    degree = "1" if kind == "LINEAR" else samples.meta.get("INTERPOLATION_DEGREE", "")
    if not degree.isdecimal():
        interpolation = samples.meta["INTERPOLATION"]
        raise TrajectoryError(f"INTERPOLATION = {interpolation} needs INTERPOLATION_DEGREE, a whole number")
    return PolynomialPath(samples.since_first_ns(), places, int(degree), velocities if kind == "HERMITE" else None)


def _world_from_body(meta: dict[str, str], cells: list[str]) -> Floats:
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
