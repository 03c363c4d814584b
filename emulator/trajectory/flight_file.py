"""PANGU flight files (.fli), as far as public examples show them: one pose a line, # starts a comment.

    start x y z yaw pitch roll          an absolute pose, degrees
    x y z yaw pitch roll                increments to the pose before
    quaternion x y z q0 qx qy qz        an absolute pose
    pause seconds                       the pose before, for that much longer
    sun_position r azimuth elevation    read and counted as left out, as are all other commands

The file holds no times: each pose follows the one before by `period_s`. With all angles at zero the camera looks along
+x of the world, with +z up; yaw turns it to the left about +z, pitch up, roll clockwise about the line of sight. (This
is how the public examples read; no description of the format that binds was found.) With a `quaternion` the camera's
own axes are those of a PANGU camera file for OpenCV's look: forward +z, up -y, right +x.

Seen in: VidForIrene.java by N. Rowell and a flight file in a public repository.

Trajectories as tables of comma-separated numbers.

    t_s,x_m,y_m,z_m,qw,qx,qy,qz
    0.0,0,0,-7000,1,0,0,0
    1.0,...

The first line names the columns, in any order; others are ignored. `t_s` and the place are needed; without the four of
the attitude it stays that of the world (to be combined with `look_at_m`). Lines that start with # are comments.
"""

from __future__ import annotations

import csv
import math
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import quaternion_of
from emulator.trajectory.mounting import looking_along
from emulator.trajectory.pose import FARTHEST_M, STILL, Pose, TrajectoryError

_PLACE = ("x_m", "y_m", "z_m")
_ATTITUDE = ("qw", "qx", "qy", "qz")


@dataclass(eq=False)
class Samples:
    """Times and poses of a file."""

    times_ns: list[int] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)


def parse_table(text: str) -> Samples:
    """Read a table; raises TrajectoryError with the line."""
    lines = list(_lines(text.splitlines()))
    if not lines:
        raise TrajectoryError("an empty trajectory: the first line must name the columns, for instance t_s,x_m,y_m,z_m")
    columns = {name: k for k, name in enumerate(lines[0][1])}
    missing = [name for name in ("t_s", *_PLACE) if name not in columns]
    if missing:
        raise TrajectoryError(f"line {lines[0][0]}: column {', '.join(missing)} is missing among {', '.join(columns)}")
    samples = Samples()
    for number, cells in lines[1:]:
        try:
            _read(samples, columns, cells)
        except (ValueError, IndexError, OverflowError) as error:
            raise TrajectoryError(f"line {number}: {error}") from error
    return samples


def _lines(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number (from 1) and the cells of each line that holds any."""
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                yield number, [cell.strip() for cell in next(csv.reader([line]))]
            except csv.Error as error:
                raise TrajectoryError(f"line {number}: {error}") from error


def _read(samples: Samples, columns: dict[str, int], cells: list[str]) -> None:
    def numbers(names: Iterable[str]) -> list[float]:
        return [float(cells[columns[name]]) for name in names]

    place = np.array(numbers(_PLACE))
    has_attitude = all(name in columns for name in _ATTITUDE)
    attitude = np.array(numbers(_ATTITUDE)) if has_attitude else STILL.q_world_from_body
    (t_s,) = numbers(["t_s"])
    if not math.isfinite(t_s):
        raise ValueError(f"time {t_s} s: must be finite")
    samples.poses.append(Pose(place, attitude))
    samples.times_ns.append(round(t_s * 1e9))


@dataclass(eq=False)
class Flight:
    """Contents of a flight file.

    Attributes
    ----------
    samples : its poses, `period_s` apart but for pauses.
    left_out : how often each other command stood in it.
    """

    samples: Samples = field(default_factory=Samples)
    left_out: Counter[str] = field(default_factory=Counter)


@dataclass
class _Reader:
    period_ns: int
    flight: Flight = field(default_factory=Flight)
    t_ns: int = 0
    angles: npt.NDArray[np.float64] | None = None  # x y z yaw pitch roll, where known

    def read(self, words: list[str]) -> None:
        match words:
            case ["start", *numbers]:
                self._place(_numbers(numbers, 6))
            case ["quaternion", *numbers]:
                values = _numbers(numbers, 7)
                self.angles = None
                self._add(Pose(values[:3], values[3:]))
            case ["pause", *numbers]:
                (seconds,) = _numbers(numbers, 1)
                self._pause(seconds)
            case [command, *_] if command[0].isalpha():
                self.flight.left_out[command] += 1
            case numbers:
                if self.angles is None:
                    raise ValueError("increments need a `start` line before them")
                self._place(self.angles + _numbers(numbers, 6))

    def _place(self, angles: npt.NDArray[np.float64]) -> None:
        self.angles = angles
        self._add(Pose(angles[:3], _attitude(*(math.radians(a) for a in angles[3:]))))

    def _pause(self, seconds: float) -> None:
        if seconds < 0 or not self.flight.samples.poses:
            raise ValueError("a pause needs a pose before it, and time that does not go back")
        if seconds:
            self.t_ns += round(seconds * 1e9) - self.period_ns
            self._add(self.flight.samples.poses[-1])

    def _add(self, pose: Pose) -> None:
        self.flight.samples.times_ns.append(self.t_ns)
        self.flight.samples.poses.append(pose)
        self.t_ns += self.period_ns


def parse_flight(text: str, period_s: float) -> Flight:
    """Read a flight file whose poses are `period_s` apart; raises TrajectoryError with the line."""
    reader = _Reader(round(period_s * 1e9))
    for number, line in enumerate(text.splitlines(), start=1):
        words = line.partition("#")[0].split()
        try:
            if words:
                reader.read(words)
        except ValueError as error:
            raise TrajectoryError(f"line {number}: {error}") from error
    return reader.flight


def _numbers(words: list[str], count: int) -> npt.NDArray[np.float64]:
    if len(words) != count:
        raise ValueError(f"{count} numbers are expected, got {len(words)}")
    values = np.array([float(word) for word in words])
    if not (np.abs(values) <= FARTHEST_M).all():
        raise ValueError(f"numbers must be finite, at most {FARTHEST_M:g}, got {' '.join(words)}")
    return values


def _attitude(yaw: float, pitch: float, roll: float) -> npt.NDArray[np.float64]:
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    up = np.array([-math.cos(yaw) * math.sin(pitch), -math.sin(yaw) * math.sin(pitch), math.cos(pitch)])
    right = np.cross(forward, up)
    return quaternion_of(looking_along(forward, math.cos(roll) * up + math.sin(roll) * right))
