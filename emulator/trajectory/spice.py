"""Camera paths from SPICE kernels, by spiceypy.

The world is the reference frame with the target at its origin, so the camera is at minus the place of the target as
the camera's observer sees it, with the aberration correction that the rig names. With a light time correction a
reference frame that turns with the target is taken when the light left it, as SPICE does it.

SPICE is read once, when the path is built, in a child process (see `guarded_reader`): CSPICE does not check the numbers
in a kernel, and damaged ones end its process. Its time is seconds since 2000, whose steps of 0.1 us would make
accelerations from differences of places useless. The states and attitudes at even instants become a `Keyframes` path.
Half-way between the instants the path is compared with SPICE, and their number is doubled until it is as near as this:

    place      a tenth of a metre, a tenth of an arc-second as seen from the target, or SPICE's own step of time
    attitude   a tenth of an arc-second
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import quaternion_of
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.parameters import SpicePath
from emulator.trajectory.pose import STILL, Pose, TrajectoryError, turn_rad
from firmware_protocol.events import Floats
from transports.guarded_reader import ForeignFileError, Limits, read_guarded

_LIMITS = Limits(1 << 30, 60)  # CSPICE reads records of a kernel, not all of it
_KM = 1e3
_PLACE_M, _ANGLE_RAD = 0.1, math.radians(0.1 / 3600)
_STEP_S = 2.4e-7  # two steps of SPICE's time in this century
_FEWEST, _MOST = 16, 1 << 14  # intervals


def read_spice(p: SpicePath) -> Keyframes:
    """Return the path of a rig's SPICE table, from time 0 to its duration; before and after it the nearest pose holds.

    Raises TrajectoryError without spiceypy, and where the kernels do not give the path closely enough.
    """
    for kernel in p.kernels:
        if not Path(kernel).is_file():
            raise TrajectoryError(f"kernel {kernel} is missing: put it there, or correct `kernels`")
    try:
        read = read_guarded(f"{__name__}:read_kernels", Path(p.kernels[0]), asdict(p), limits=_LIMITS)
    except ForeignFileError as error:
        raise TrajectoryError(f"one of the kernels {', '.join(p.kernels)}: {error}") from None
    poses = [Pose(place, turn) for place, turn in zip(read["places"], read["turns"], strict=True)]
    return Keyframes(read["times_ns"].tolist(), poses, read["velocities"])


def read_kernels(_: Path, parameters: Mapping[str, Any]) -> dict[str, npt.NDArray[Any]]:
    """Return the keyframes of a SPICE table: `times_ns` (n,), `places` (n, 3), `turns` (n, 4), `velocities` (n, 3)."""
    import spiceypy  # an extra; in the child process alone

    p = SpicePath(**parameters)
    try:
        spiceypy.furnsh(list(p.kernels))
        return _followed(spiceypy, p)
    except spiceypy.SpiceyError as error:
        reason = " ".join(f"{error.short} {error.explain} {error.long}".split())
        raise TrajectoryError(f"SPICE: {reason or type(error).__name__}{_coverage(spiceypy, p)}") from error


def _followed(spice: Any, p: SpicePath) -> dict[str, npt.NDArray[Any]]:
    """Return the keyframes of a path as near to SPICE, whose kernels are loaded, as it must be; see `read_kernels`."""
    start_s = float(spice.str2et(p.start_utc))

    def sample(t_ns: int) -> tuple[Pose, Floats]:
        """Return the camera's pose and velocity, m/s, (3,)."""
        et = start_s + t_ns * 1e-9
        state, light_s = spice.spkezr(p.target, et, p.frame, p.aberration, p.observer)
        place, velocity = -_KM * np.asarray(state[:3]), -_KM * np.asarray(state[3:])
        if not p.camera_frame:
            return Pose(place, STILL.q_world_from_body), velocity
        left_s = et if p.aberration == "NONE" else et - light_s
        turn = spice.pxfrm2(p.camera_frame, p.frame, et, left_s)
        return Pose(place, quaternion_of(np.asarray(turn))), velocity

    times_ns = np.linspace(0, round(p.duration_s * 1e9), _FEWEST + 1).astype(np.int64)
    samples = [sample(int(t)) for t in times_ns]
    while True:
        poses, velocities = [pose for pose, _ in samples], np.array([velocity for _, velocity in samples])
        path = Keyframes(times_ns.tolist(), poses, velocities)
        half_ns = (times_ns[:-1] + times_ns[1:]) // 2
        between = [sample(int(t)) for t in half_ns]
        off = np.max([_distance(path.pose(int(t)), *exact) for t, exact in zip(half_ns, between, strict=True)], axis=0)
        if off.max() <= 1:
            places = np.array([pose.position_m for pose in poses])
            turns = np.array([pose.q_world_from_body for pose in poses])
            return {"times_ns": times_ns, "places": places, "turns": turns, "velocities": velocities}
        if 2 * half_ns.size > _MOST:
            raise TrajectoryError(
                f"the kernels' path cannot be followed: between {half_ns.size} instants it is {off.max():.3g} times as "
                f"far off as it may be in {'place' if off[0] >= off[1] else 'attitude'}; shorten duration_s, or choose "
                "an aberration or a camera_frame that does not jump"
            )
        times_ns = np.insert(times_ns, np.arange(1, times_ns.size), half_ns)
        samples = [of for pair in zip(samples, [*between, None], strict=True) for of in pair if of is not None]


def _distance(pose: Pose, expected: Pose, velocity: Floats) -> tuple[float, float]:
    """Return how far a pose is off, in place and in attitude, over what is allowed."""
    near_m = min(_PLACE_M, _ANGLE_RAD * float(np.linalg.norm(expected.position_m)))
    allowed_m = max(near_m, _STEP_S * float(np.linalg.norm(velocity)), 1e-9)
    off_m = float(np.linalg.norm(pose.position_m - expected.position_m))
    return off_m / allowed_m, turn_rad(pose, expected) / _ANGLE_RAD


def _coverage(spice: Any, p: SpicePath) -> str:
    """Return the times for which the kernels have the observer, as a sentence; empty where they cannot be read."""
    times = []
    try:
        observer = spice.bods2c(p.observer)
        for number in range(spice.ktotal("SPK")):
            window = spice.spkcov(spice.kdata(number, "SPK")[0], observer)
            for k in range(spice.wncard(window)):
                first, last = (spice.et2utc(et, "ISOC", 3) for et in spice.wnfetd(window, k))
                times.append(f"{first} to {last}")
    except spice.SpiceyError:
        times.clear()
    return f" (places of {p.observer} cover {', '.join(times)} UTC)" if times else ""
