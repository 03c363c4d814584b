"""Camera paths from SPICE kernels, by spiceypy.

The world is the reference frame with the target at its origin, so the camera is at minus the place of the target as
the camera's observer sees it, with the aberration correction that the rig names. With a light time correction a
reference frame that turns with the target is taken when the light left it, as SPICE does it.

SPICE is read once, when the path is built: CSPICE has one pool of kernels for a process, which one thread may use, and
its time is seconds since 2000, whose steps of 0.1 us would make accelerations from differences of places useless. The
states and attitudes at even instants become a `Keyframes` path. Half-way between the instants the path is compared with
SPICE, and their number is doubled until it is as near as this:

    place      a tenth of a metre, a tenth of an arc-second as seen from the target, or SPICE's own step of time
    attitude   a tenth of an arc-second
"""

from __future__ import annotations

import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from emulator.geometry.attitude import quaternion_of
from emulator.trajectory.keyframes import Keyframes
from emulator.trajectory.pose import STILL, Pose, TrajectoryError, turn_rad

if TYPE_CHECKING:
    from emulator.trajectory.parameters import SpicePath

__all__ = ["read_spice"]


_LOCK = Lock()
_KM = 1e3
_PLACE_M, _ANGLE_RAD = 0.1, math.radians(0.1 / 3600)
_STEP_S = 2.4e-7  # two steps of SPICE's time in this century
_FEWEST, _MOST = 16, 1 << 14  # intervals

_Floats = npt.NDArray[np.float64]


def read_spice(p: SpicePath) -> Keyframes:
    """Return the path of a rig's SPICE table, from time 0 to its duration; before and after it the nearest pose holds.

    Raises
    ------
    TrajectoryError
        Without spiceypy, where the kernels do not give the path, and where it cannot be followed closely enough.
    """
    spice = _spiceypy()
    for kernel in p.kernels:
        if not Path(kernel).is_file():
            raise TrajectoryError(f"kernel {kernel} is missing: put it there, or correct `kernels`")
    with _LOCK, _named_errors(spice, p), spice.KernelPool(list(p.kernels)), _named_errors(spice, p):
        return _followed(_Query(spice, p))


def _spiceypy() -> Any:
    try:
        return importlib.import_module("spiceypy")
    except ImportError as error:
        raise TrajectoryError("a path of kind `spice` needs spiceypy: pip install spiceypy") from error


class _Query:
    """Poses and velocities of the camera by SPICE, whose kernels are loaded."""

    def __init__(self, spice: Any, p: SpicePath) -> None:
        self._spice, self._p = spice, p
        self._start_s = float(spice.str2et(p.start_utc))
        self.last_ns = round(p.duration_s * 1e9)

    def at(self, t_ns: int) -> tuple[Pose, _Floats]:
        """Return the pose and the velocity, m/s, (3,)."""
        p, et = self._p, self._start_s + t_ns * 1e-9
        state, light_s = self._spice.spkezr(p.target, et, p.frame, p.aberration, p.observer)
        place, velocity = -_KM * np.asarray(state[:3]), -_KM * np.asarray(state[3:])
        if not p.camera_frame:
            return Pose(place, STILL.q_world_from_body), velocity
        left_s = et if p.aberration == "NONE" else et - light_s
        turn = self._spice.pxfrm2(p.camera_frame, p.frame, et, left_s)
        return Pose(place, quaternion_of(np.asarray(turn))), velocity


def _followed(query: _Query) -> Keyframes:
    """Return a path as near to SPICE as it must be."""
    times_ns = np.linspace(0, query.last_ns, _FEWEST + 1).astype(np.int64)
    known = [query.at(int(t)) for t in times_ns]
    while True:
        path = Keyframes(times_ns.tolist(), [pose for pose, _ in known], np.array([velocity for _, velocity in known]))
        half_ns = (times_ns[:-1] + times_ns[1:]) // 2
        between = [query.at(int(t)) for t in half_ns]
        off = np.max([_distance(path.pose(int(t)), *one) for t, one in zip(half_ns, between, strict=True)], axis=0)
        if off.max() <= 1:
            return path
        if 2 * half_ns.size > _MOST:
            raise TrajectoryError(
                f"the kernels' path cannot be followed: between {half_ns.size} instants it is {off.max():.3g} times as "
                f"far off as it may be in {'place' if off[0] >= off[1] else 'attitude'}; shorten duration_s, or choose "
                "an aberration or a camera_frame that does not jump"
            )
        times_ns = np.insert(times_ns, np.arange(1, times_ns.size), half_ns)
        known = [one for pair in zip(known, [*between, None], strict=True) for one in pair if one is not None]


def _distance(found: Pose, expected: Pose, velocity: _Floats) -> tuple[float, float]:
    """Return how far a pose is off, in place and in attitude, over what is allowed."""
    near_m = min(_PLACE_M, _ANGLE_RAD * float(np.linalg.norm(expected.position_m)))
    allowed_m = max(near_m, _STEP_S * float(np.linalg.norm(velocity)), 1e-9)
    off_m = float(np.linalg.norm(found.position_m - expected.position_m))
    return off_m / allowed_m, turn_rad(found, expected) / _ANGLE_RAD


@contextmanager
def _named_errors(spice: Any, p: SpicePath) -> Iterator[None]:
    """Raise SPICE's errors as TrajectoryError, with the times that the kernels cover if they are loaded."""
    try:
        yield
    except spice.utils.exceptions.SpiceyError as error:
        spice.reset()
        raise TrajectoryError(f"SPICE: {_reason(error)}{_coverage(spice, p)}") from error


def _reason(error: Exception) -> str:
    parts = (getattr(error, name, "") for name in ("short", "explain", "long"))
    return " ".join(" ".join(str(part).split()) for part in parts if part) or type(error).__name__


def _coverage(spice: Any, p: SpicePath) -> str:
    """Return the times for which the kernels have the observer, as a sentence; empty where they cannot be read."""
    found = []
    try:
        observer = spice.bods2c(p.observer)
        for number in range(spice.ktotal("SPK")):
            window = spice.spkcov(spice.kdata(number, "SPK")[0], observer)
            for k in range(spice.wncard(window)):
                first, last = (spice.et2utc(et, "ISOC", 3) for et in spice.wnfetd(window, k))
                found.append(f"{first} to {last}")
    except spice.utils.exceptions.SpiceyError:
        spice.reset()
    return f" (places of {p.observer} cover {', '.join(found)} UTC)" if found else ""
