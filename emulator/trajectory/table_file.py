"""Trajectories as tables of comma-separated numbers.

    t_s,x_m,y_m,z_m,qw,qx,qy,qz
    0.0,0,0,-7000,1,0,0,0
    1.0,...

The first line names the columns, in any order; others are ignored. `t_s` and the place are needed; without the four of
the attitude it stays that of the world (to be combined with `look_at_m`). Lines that start with # are comments.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field

import numpy as np

from emulator.trajectory.pose import STILL, Pose, TrajectoryError

__all__ = ["Samples", "parse_table"]

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
