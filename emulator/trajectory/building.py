"""Trajectories from a rig's tables.

The paths of one scene are built together, because live ones share a port: the camera is number 0, bodies follow.

A trajectory from files has one file for the places and perhaps one for the attitudes, each at its own times. Time 0 is
the first place. Attitudes are taken at the epochs of their own file (CCSDS AEM); beside a table or a flight
file, which have no epochs, they begin at time 0.

An inertial unit uses the path of the scene's camera.

PANGU flight files (.fli), as far as public examples show them: one pose a line, # starts a comment.

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
import logging
import math
from collections import Counter
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from fractions import Fraction
from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import quaternion_of
from emulator.geometry.camera import Cycle
from emulator.tables.toml_text import TextFileError, read_text, shortened
from emulator.trajectory.ccsds_file import CcsdsPath, parse_aem, parse_oem
from emulator.trajectory.joints import Jointed, JointPath
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.laws import Descent, Orbit
from emulator.trajectory.live import GivenPath, PoseReceiver, ReceivedPath, SimulatedPath, close_receivers
from emulator.trajectory.mounting import Looking, Mounted, PlaceAndAttitude, Spinning, looking_along
from emulator.trajectory.parameters import (
    BasiliskPath,
    DescentPath,
    FilePath,
    FixedPath,
    KeyframePath,
    LivePath,
    OrbitPath,
    SpicePath,
    SpinPath,
    TrajectoryParameters,
)
from emulator.trajectory.pose import (
    FARTHEST_M,
    OPENGL_FROM_CAMERA,
    STILL,
    Fixed,
    Pose,
    Timescale,
    Trajectory,
    TrajectoryError,
)
from emulator.trajectory.spice import read_spice

_MOST_BYTES = 1 << 28
_LOG = logging.getLogger(__name__)

_PLACE = ("x_m", "y_m", "z_m")
_ATTITUDE = ("qw", "qx", "qy", "qz")


@dataclass(eq=False)
class Samples:
    """Times and poses of a file; `left_out` is how often each other command stood in a flight file."""

    times_ns: list[int] = field(default_factory=list)
    poses: list[Pose] = field(default_factory=list)
    left_out: Counter[str] = field(default_factory=Counter)


def parse_table(text: str) -> Samples:
    """Read a table; raises TrajectoryError with the line."""
    lines = list(_table_lines(text.splitlines()))
    if not lines:
        raise TrajectoryError("an empty trajectory: the first line must name the columns, for instance t_s,x_m,y_m,z_m")
    columns = {name: k for k, name in enumerate(lines[0][1])}
    missing = [name for name in ("t_s", *_PLACE) if name not in columns]
    if missing:
        raise TrajectoryError(f"line {lines[0][0]}: column {', '.join(missing)} is missing among {', '.join(columns)}")
    samples = Samples()
    has_attitude = all(name in columns for name in _ATTITUDE)
    for number, cells in lines[1:]:
        try:
            t_s, *place = (float(cells[columns[name]]) for name in ("t_s", *_PLACE))
            if not math.isfinite(t_s):
                raise ValueError(f"time {t_s} s: must be finite")
            attitude = [float(cells[columns[name]]) for name in _ATTITUDE] if has_attitude else STILL.q_world_from_body
            samples.poses.append(Pose(np.array(place), np.array(attitude)))
            samples.times_ns.append(round(t_s * 1e9))
        except (ValueError, IndexError, OverflowError) as error:
            raise TrajectoryError(f"line {number}: {error}") from error
    return samples


def _table_lines(lines: Iterable[str]) -> Iterator[tuple[int, list[str]]]:
    """Yield the number (from 1) and the cells of each line that holds any."""
    for number, line in enumerate(lines, start=1):
        if line.strip() and not line.lstrip().startswith("#"):
            try:
                yield number, [cell.strip() for cell in next(csv.reader([line]))]
            except csv.Error as error:
                raise TrajectoryError(f"line {number}: {error}") from error


def parse_flight(text: str, period_s: float) -> Samples:
    """Read a flight file whose poses are `period_s` apart; raises TrajectoryError with the line."""
    flight = Samples()
    period_ns, t_ns = round(period_s * 1e9), 0
    angles: npt.NDArray[np.float64] | None = None  # x y z yaw pitch roll, where known
    for number, line in enumerate(text.splitlines(), start=1):
        try:
            match line.partition("#")[0].split():
                case []:
                    continue
                case ["quaternion", *words]:
                    values = _flight_numbers(words, 7)
                    angles, pose = None, Pose(values[:3], values[3:])
                case ["pause", *words]:
                    (seconds,) = _flight_numbers(words, 1)
                    if seconds < 0 or not flight.poses:
                        raise ValueError("a pause needs a pose before it, and time that does not go back")
                    if not seconds:
                        continue
                    t_ns += round(seconds * 1e9) - period_ns
                    pose = flight.poses[-1]
                case [command, *_] if command != "start" and command[0].isalpha():
                    flight.left_out[command] += 1
                    continue
                case [command, *words]:
                    is_start = command == "start"
                    if angles is None and not is_start:
                        raise ValueError("increments need a `start` line before them")
                    values = _flight_numbers(words if is_start else [command, *words], 6)
                    angles = values if is_start or angles is None else angles + values
                    pose = Pose(angles[:3], _flight_attitude(*(math.radians(a) for a in angles[3:])))
        except ValueError as error:
            raise TrajectoryError(f"line {number}: {error}") from error
        flight.times_ns.append(t_ns)
        flight.poses.append(pose)
        t_ns += period_ns
    return flight


def _flight_numbers(words: list[str], count: int) -> npt.NDArray[np.float64]:
    if len(words) != count:
        raise ValueError(f"{count} numbers are expected, got {len(words)}")
    values = np.array([float(word) for word in words])
    if not (np.abs(values) <= FARTHEST_M).all():
        raise ValueError(f"numbers must be finite, at most {FARTHEST_M:g}, got {' '.join(words)}")
    return values


def _flight_attitude(yaw: float, pitch: float, roll: float) -> npt.NDArray[np.float64]:
    forward = np.array([math.cos(yaw) * math.cos(pitch), math.sin(yaw) * math.cos(pitch), math.sin(pitch)])
    up = np.array([-math.cos(yaw) * math.sin(pitch), -math.sin(yaw) * math.sin(pitch), math.cos(pitch)])
    right = np.cross(forward, up)
    return quaternion_of(looking_along(forward, math.cos(roll) * up + math.sin(roll) * right))


_Span = tuple[int, int]


def read_path(p: FilePath) -> tuple[Trajectory, _Span]:
    """Return the path of the files that a rig names, and its first and last time; raises TrajectoryError."""
    path = Path(p.path)
    try:
        orbit = parse_oem(read_text(path, _MOST_BYTES)) if path.suffix.lower() == ".oem" else None
        places = orbit.path if orbit else _keyframes(path, p.period_s)
    except (TrajectoryError, TextFileError) as error:
        raise TrajectoryError(f"{p.path}: {shortened(error)}") from error
    start_ns, stop_ns = places.span_ns
    zero_ns = start_ns if orbit else 0
    try:
        attitudes, attitudes_zero_ns = _attitudes(p, places.span_ns, orbit) if p.attitude_path else (places, zero_ns)
    except (TrajectoryError, TextFileError) as error:
        raise TrajectoryError(f"{p.attitude_path}: {shortened(error)}") from error
    combined: Trajectory = PlaceAndAttitude(places, attitudes, zero_ns, attitudes_zero_ns)
    camera = Mounted(combined, Pose(np.zeros(3), OPENGL_FROM_CAMERA)) if p.axes == "opengl" else combined
    return camera, (start_ns - zero_ns, stop_ns - zero_ns)


def _keyframes(path: Path, period_s: float) -> Keyframes:
    match path.suffix.lower():
        case ".fli":
            samples = parse_flight(read_text(path, _MOST_BYTES), period_s)
        case ".csv":
            samples = parse_table(read_text(path, _MOST_BYTES))
        case _:
            raise TrajectoryError("its format is unknown: name it .csv, .oem or .fli")
    if samples.left_out:
        left_out = ", ".join(f"{count} {command}" for command, count in samples.left_out.items())
        _LOG.info("%s: left out of the flight: %s", path, left_out)
    return Keyframes(samples.times_ns, samples.poses)


def _attitudes(p: FilePath, span_ns: _Span, orbit: CcsdsPath | None) -> tuple[Trajectory, int]:
    """Return the attitudes, and the time on their axis that is time 0 of the path."""
    file = parse_aem(read_text(Path(p.attitude_path), _MOST_BYTES))
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
    for quantity, of_orbit, of_attitudes in (
        ("TIME_SYSTEM", orbit.scale, attitudes.scale),
        ("reference frame", orbit.axes, attitudes.axes),
    ):
        if of_orbit and of_attitudes and of_orbit != of_attitudes:
            raise TrajectoryError(
                f"its {quantity} is {of_attitudes}, and that of the orbit file {of_orbit}: convert one of them"
            )


@dataclass(frozen=True)
class MountedPath:
    """Parameters of a body that is mounted on a path; no rig writes it."""

    path: TrajectoryParameters
    offset_m: tuple[float, float, float]
    q_path_from_body: tuple[float, float, float, float]


_Triple = tuple[float, float, float]
_MEASURED = 1024  # instants at which a path's turning is measured


def build_trajectories(paths: Sequence[TrajectoryParameters | JointPath | GivenPath]) -> list[Trajectory]:
    """Return the trajectories of a scene's camera and bodies, in this order; raises as `build_trajectory`."""
    receivers: dict[tuple[str, int], PoseReceiver] = {}
    built: list[Trajectory] = []
    try:
        for number, p in enumerate(paths):
            built.append(_received(p, number, receivers) if isinstance(p, LivePath) else build_trajectory(p))
    except (TrajectoryError, OSError):
        close_receivers(*built)
        raise
    return built


def build_trajectory(p: TrajectoryParameters | MountedPath | JointPath | GivenPath) -> Trajectory:
    """Return the trajectory of a rig's table; raises TrajectoryError, and OSError where a port is not available."""
    match p:
        case FixedPath():
            fixed = Fixed(Pose(np.array(p.position_m), np.array(p.q_world_from_body)))
            path: Trajectory = _looking(fixed, p.look_at_m, p.up, [0, 1])
        case KeyframePath():
            poses = [Pose(np.array(k.position_m), np.array(k.q_world_from_body)) for k in p.keyframes]
            keyframes = Keyframes([round(k.t_s * 1e9) for k in p.keyframes], poses)
            path = _looking(keyframes, p.look_at_m, p.up, _spread(*keyframes.span_ns))
        case OrbitPath():
            path = Looking(Orbit(p), p.look_at_m, p.up, _spread(0, round(p.period_s * 1e9)))
        case SpinPath():
            path = _spinning(p)
        case DescentPath():
            path = Descent(p.gates, p.heading_deg, p.site_m)
        case FilePath():
            recorded, span_ns = read_path(p)
            path = _looking(recorded, p.look_at_m, p.up, _spread(*span_ns))
        case LivePath():
            path = _received(p, 0, {})
        case GivenPath():
            path = p.path
        case JointPath():
            path = Jointed(p)
        case SpicePath():
            flown = read_spice(p)
            target_m = None if p.camera_frame else (0.0, 0.0, 0.0)
            path = _looking(flown, target_m, p.up, _spread(*flown.span_ns))
        case BasiliskPath():
            path = SimulatedPath(Fixed(Pose(np.array(p.position_m), np.array(p.q_world_from_body))))
        case MountedPath():
            mounting = Pose(np.array(p.offset_m), np.array(p.q_path_from_body))
            path = Mounted(build_trajectory(p.path), mounting)
    return path


def _received(p: LivePath, number: int, receivers: dict[tuple[str, int], PoseReceiver]) -> ReceivedPath:
    """Return the live path of camera or body `number`, on a receiver that others may use already."""
    receiver = receivers.get((p.host, p.port)) or PoseReceiver(p.host, p.port, p.allow)
    receivers[p.host, p.port] = receiver
    if receiver.allow != frozenset(p.allow):
        raise TrajectoryError(f"live paths that share port {p.port} must have the same addresses in `allow`")
    first = Pose(np.array(p.position_m), np.array(p.q_world_from_body))
    return ReceivedPath(receiver, number, first, round(p.hold_ms * 1e6), round(p.ahead_ms * 1e6))


def _looking(path: Trajectory, target_m: _Triple | None, up: _Triple, times_ns: Sequence[int]) -> Trajectory:
    return path if target_m is None else Looking(path, target_m, up, times_ns)


def _spread(first_ns: int, last_ns: int) -> list[int]:
    return [int(t) for t in np.linspace(first_ns, max(last_ns, first_ns + 1), _MEASURED).astype(np.int64)]


def _spinning(p: SpinPath) -> Spinning:
    def turns(degrees: float) -> Fraction:
        return Fraction(repr(float(degrees))) / 360

    turned = Cycle(turns(p.spin_deg_s), turns(p.start_deg))
    return Spinning(p.position_m, p.pole, turned, math.radians(p.tilt_deg), Cycle(turns(p.precession_deg_s)))


@runtime_checkable
class HasCameraPath(Protocol):
    """A scene whose camera moves on `camera_path`, on the scene's time; `path_time` is stream time to that."""

    camera_path: Trajectory
    path_time: Timescale
