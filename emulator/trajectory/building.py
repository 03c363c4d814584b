"""Trajectories from a rig's tables.

The paths of one scene are built together, because live ones share a port: the camera is number 0, bodies follow.
"""

from __future__ import annotations

from collections.abc import Sequence
from fractions import Fraction

import numpy as np

from emulator.geometry.cycle import Cycle
from emulator.trajectory.basilisk import flown_path
from emulator.trajectory.descent import Descent
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.live import LivePoses
from emulator.trajectory.looking import Looking
from emulator.trajectory.offset import Offset, OffsetPath
from emulator.trajectory.orbit import Orbit
from emulator.trajectory.parameters import (
    BasiliskPath,
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
from emulator.trajectory.recorded import read_path
from emulator.trajectory.spinning import Spinning, Tilt

__all__ = ["build_trajectories", "build_trajectory"]

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


def build_trajectory(p: TrajectoryParameters | OffsetPath) -> Trajectory:
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
            recorded, span_ns = read_path(p)
            return _looking(recorded, p.look_at_m, p.up, _spread(*span_ns))
        case LivePath():
            return _received(p, 0, {})
        case OffsetPath() | BasiliskPath():
            return _derived(p)


def _derived(p: OffsetPath | BasiliskPath) -> Trajectory:
    if isinstance(p, BasiliskPath):
        return flown_path(p)
    return Offset(build_trajectory(p.path), p.offset_m, p.q_path_from_body)


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
