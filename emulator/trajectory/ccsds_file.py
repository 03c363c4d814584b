"""CCSDS orbit and attitude files in keyword notation: OEM (502.0-B) and AEM (504.0-B), as far as a scene needs them.

OEM, after its header and metadata (META_START ... META_STOP), one line a sample, km and km/s:

    epoch  X Y Z  [X_DOT Y_DOT Z_DOT  [accelerations, ignored]]

AEM, likewise, with ATTITUDE_TYPE = QUATERNION, one line a sample:

    epoch  Q1 Q2 Q3 QC        (QUATERNION_TYPE = LAST, the default here and in version 2, where the keyword is gone)
    epoch  QC Q1 Q2 Q3        (QUATERNION_TYPE = FIRST)

A CCSDS quaternion turns coordinates: with ATTITUDE_DIR = A2B (the default) it is B from A, with B2A it is A from B.
Ours is world from body, so whichever frame is the spacecraft's (its name starts with SC_ or names an instrument; else
REF_FRAME_B) is taken for the body. Epochs are `2000-04-30T12:00:00.5` or `2000-121T12:00:00.5`, all in one time
system; stream time 0 is the first sample. Several segments are joined. Leap seconds within a file are not looked for.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from fractions import Fraction

import numpy as np

from emulator.trajectory.pose import STILL, Pose, TrajectoryError
from emulator.trajectory.table_file import Samples

__all__ = ["parse_aem", "parse_oem"]

_EPOCH = re.compile(r"(\d{4})-(?:(\d{3})|(\d{2})-(\d{2}))T(\d{2}):(\d{2}):(\d{2})(\.\d+)?Z?$")
_KEYWORD = re.compile(r"([A-Z][A-Z0-9_]*)\s*=\s*(.*)$")
_MARKS = re.compile(r"(META|DATA|COVARIANCE)_(START|STOP)$")

_Line = tuple[int, dict[str, str], list[str]]


def parse_oem(text: str) -> Samples:
    """Read an orbit file: places in metres, attitudes those of the world; raises TrajectoryError with the line."""
    samples, epochs = Samples(), list[int]()
    for number, _, cells in _data_lines(text):
        try:
            values = np.array([float(cell) for cell in cells[1:]]) * 1000.0
            if len(values) not in (3, 6, 9):
                raise ValueError(f"an epoch and 3, 6 or 9 numbers are expected, got {len(values)}")
            epochs.append(_epoch_ns(cells[0]))
            samples.poses.append(Pose(values[:3], STILL.q_world_from_body))
        except ValueError as error:
            raise TrajectoryError(f"line {number}: {error}") from error
        if len(values) >= 6:
            samples.velocities_m_s.append((values[3], values[4], values[5]))
    if len(samples.velocities_m_s) != len(samples.poses):
        samples.velocities_m_s.clear()  # a spline through places is better than velocities for some of them
    return _since_first(samples, epochs)


def parse_aem(text: str) -> Samples:
    """Read an attitude file: attitudes at the origin; raises TrajectoryError with the line."""
    samples, epochs = Samples(), list[int]()
    for number, meta, cells in _data_lines(text):
        try:
            epochs.append(_epoch_ns(cells[0]))
            samples.poses.append(Pose(np.zeros(3), _world_from_body(meta, cells[1:])))
        except ValueError as error:
            raise TrajectoryError(f"line {number}: {error}") from error
    return _since_first(samples, epochs)


def _since_first(samples: Samples, epochs: list[int]) -> Samples:
    if not epochs:
        raise TrajectoryError("an empty trajectory: the file holds no samples")
    samples.times_ns = [epoch - epochs[0] for epoch in epochs]
    return samples


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


def _epoch_ns(text: str) -> int:
    """Return the nanoseconds since the year 1; differences are what counts."""
    found = _EPOCH.match(text)
    if not found:
        raise ValueError(f"epoch {text!r}: expected yyyy-mm-ddThh:mm:ss or yyyy-dddThh:mm:ss")
    year, day_of_year, month, day, hour, minute, second, fraction = found.groups()
    date = datetime(int(year), int(month or 1), int(day or 1), int(hour), int(minute), tzinfo=UTC)
    if day_of_year:
        date += timedelta(days=int(day_of_year) - 1)
    whole = (date - datetime(1, 1, 1, tzinfo=UTC)) // timedelta(seconds=1) + int(second)  # 60 in a leap second
    return whole * 10**9 + int(Fraction(fraction or "0") * 10**9)


def _world_from_body(meta: dict[str, str], cells: list[str]) -> np.ndarray:
    if meta.get("ATTITUDE_TYPE", "QUATERNION") != "QUATERNION":
        raise ValueError(f"ATTITUDE_TYPE {meta['ATTITUDE_TYPE']} is not read; convert it to QUATERNION")
    if len(cells) < 4:
        raise ValueError(f"an epoch and four components are expected, got {len(cells)}")
    q = np.array([float(cell) for cell in cells[:4]])
    if meta.get("QUATERNION_TYPE", "LAST") == "LAST":
        q = np.roll(q, 1)
    # In components, `B from A` turns coordinates; the turn that takes A's axes into B's is world from body where A is
    # the world, and has the same four numbers.
    a_is_world = not _is_spacecraft(meta.get("REF_FRAME_A", ""))
    is_b_from_a = meta.get("ATTITUDE_DIR", "A2B") == "A2B"
    return q if a_is_world == is_b_from_a else q * np.array([1.0, -1.0, -1.0, -1.0])


def _is_spacecraft(frame: str) -> bool:
    return bool(
        re.match(r"(SC_|INSTRUMENT|ACC_|ACTUATOR|AST_|CSS|DSS|ESA|GYRO|IMU|MAG|MTA|SSA|STARTRACKER|TAM)", frame)
    )
