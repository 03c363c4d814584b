"""Trajectories from a rig's tables.

The paths of one scene are built together, because live ones share a port: the camera is number 0, bodies follow.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from fractions import Fraction
from pathlib import Path

import numpy as np

from emulator.geometry.cycle import Cycle
from emulator.trajectory.ccsds_file import parse_aem, parse_oem
from emulator.trajectory.conventions import from_opengl
from emulator.trajectory.descent import Descent
from emulator.trajectory.flight_file import parse_flight
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.live import LivePoses
from emulator.trajectory.looking import Looking
from emulator.trajectory.orbit import Orbit
from emulator.trajectory.parameters import (
    DescentPath,
    FilePath,
    FixedPath,
    KeyframePath,
    LivePath,
    OrbitPath,
    SpinPath,
    TrajectoryParameters,
)
from emulator.trajectory.pose import Fixed, Pose, Trajectory, TrajectoryError
from emulator.trajectory.pose_receiver import PoseReceiver, ReceivedPath, close_receivers
from emulator.trajectory.spinning import Spinning, Tilt
from emulator.trajectory.table_file import Samples, parse_table

__all__ = ["build_trajectories", "build_trajectory"]

_LOG = logging.getLogger(__name__)

_Triple = tuple[float, float, float]
_MEASURED = 1024  # instants at which a path's turning is measured


def build_trajectories(paths: Sequence[TrajectoryParameters]) -> list[Trajectory]:
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


def build_trajectory(p: TrajectoryParameters) -> Trajectory:
    """Return the trajectory that a rig asks for; raises TrajectoryError, and OSError where a port cannot be had."""
    match p:
        case FixedPath():
            fixed = Fixed(Pose(np.array(p.position_m), np.array(p.q_world_from_body)))
            return _looking(fixed, p.look_at_m, p.up, [0, 1])
        case KeyframePath():
            poses = [Pose(np.array(k.position_m), np.array(k.q_world_from_body)) for k in p.keyframes]
            path = Keyframes([round(k.t_s * 1e9) for k in p.keyframes], poses)
            return _looking(path, p.look_at_m, p.up, _spread(*path.span_ns))
        case OrbitPath():
            return Looking(Orbit(p), p.look_at_m, p.up, _spread(0, round(p.period_s * 1e9)))
        case SpinPath():
            return _spinning(p)
        case DescentPath():
            return Descent(p.gates, p.heading_deg, p.site_m)
        case FilePath():
            path = _read(p)
            return _looking(path, p.look_at_m, p.up, _spread(*path.span_ns))
        case LivePath():
            return _received(p, 0, {})


def _received(p: LivePath, number: int, receivers: dict[tuple[str, int], PoseReceiver]) -> ReceivedPath:
    """Return the live path of a scene's thing `number`, on a receiver that others may use already."""
    receiver = receivers.get((p.host, p.port)) or PoseReceiver(p.host, p.port, p.allow)
    receivers[p.host, p.port] = receiver
    if receiver.allow != frozenset(p.allow):
        raise TrajectoryError(f"live paths that share port {p.port} must have the same addresses in `allow`")
    first = Pose(np.array(p.position_m), np.array(p.q_world_from_body))
    return ReceivedPath(receiver, number, LivePoses(first, round(p.hold_ms * 1e6), round(p.ahead_ms * 1e6)))


def _looking(path: Trajectory, target_m: _Triple | None, up: _Triple, times_ns: Sequence[int]) -> Trajectory:
    return path if target_m is None else Looking(path, target_m, up, times_ns)


def _spread(first_ns: int, last_ns: int) -> list[int]:
    return [int(t) for t in np.linspace(first_ns, max(last_ns, first_ns + 1), _MEASURED).astype(np.int64)]


def _spinning(p: SpinPath) -> Spinning:
    def turns(degrees: float) -> Fraction:
        return Fraction(repr(float(degrees))) / 360

    turned = Cycle(turns(p.spin_deg_s), turns(p.start_deg))
    tilt = Tilt(float(np.radians(p.tilt_deg)), Cycle(turns(p.precession_deg_s)))
    return Spinning(p.position_m, p.pole, turned, tilt)


def _read(p: FilePath) -> Keyframes:
    """Read a path, and the attitudes from a file of their own where there is one."""
    try:
        samples = _samples(Path(p.path), p.period_s)
        if p.attitude_path:
            samples = _with_attitudes(samples, parse_aem(_text(Path(p.attitude_path))))
    except TrajectoryError as error:
        raise TrajectoryError(f"{p.path}: {error}") from error
    poses = samples.poses
    if p.axes == "opengl":
        poses = [Pose(pose.position_m, from_opengl(pose.q_world_from_body)) for pose in poses]
    velocities = np.array(samples.velocities_m_s) if samples.velocities_m_s else None
    try:
        return Keyframes(samples.times_ns, poses, velocities)
    except TrajectoryError as error:
        raise TrajectoryError(f"{p.path}: {error}") from error


def _samples(path: Path, period_s: float) -> Samples:
    text = _text(path)
    match path.suffix.lower():
        case ".oem":
            return parse_oem(text)
        case ".fli":
            flight = parse_flight(text, period_s)
            if flight.left_out:
                told = ", ".join(f"{count} {command}" for command, count in flight.left_out.items())
                _LOG.info("%s: left out of the flight: %s", path, told)
            return flight.samples
        case ".csv":
            return parse_table(text)
    raise TrajectoryError("which format this is cannot be told: name it .csv, .oem or .fli")


def _with_attitudes(places: Samples, attitudes: Samples) -> Samples:
    """Return the places with attitudes of their times; both files start at the same instant."""
    turning = Keyframes(attitudes.times_ns, attitudes.poses)
    poses = [
        Pose(place.position_m, turning.pose(t_ns).q_world_from_body)
        for t_ns, place in zip(places.times_ns, places.poses, strict=True)
    ]
    return Samples(places.times_ns, poses, places.velocities_m_s)


def _text(path: Path) -> str:
    try:
        return path.read_text(encoding="utf-8")
    except (OSError, UnicodeDecodeError) as error:
        raise TrajectoryError(f"cannot be read: {getattr(error, 'strerror', None) or error}") from error
