"""Camera paths from SPICE kernels, by spiceypy.

The world is the reference frame with the target at its origin, so the camera is at minus the place of the target as
the camera's observer sees it, with the aberration correction that the rig names. With a light time correction a
reference frame that turns with the target is taken when the light left it, as SPICE does it.

SPICE is queried at each time, so nothing is interpolated. CSPICE has one pool of kernels and may be used by one thread
at a time: each query holds a lock, and loads the path's own kernels where another path's are loaded.
"""

from __future__ import annotations

import importlib
from pathlib import Path
from threading import Lock
from typing import TYPE_CHECKING, Any

import numpy as np

from emulator.geometry.attitude import quaternion_of
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError, measured_bounds

if TYPE_CHECKING:
    from emulator.trajectory.parameters import SpicePath

__all__ = ["SpiceTrajectory"]


_LOCK = Lock()
_LOADED: list[tuple[str, ...]] = []
_KM = 1e3
_MEASURED = 1024


def _spiceypy() -> Any:
    try:
        return importlib.import_module("spiceypy")
    except ImportError as error:
        raise TrajectoryError("a path of kind `spice` needs spiceypy: pip install 'evstim[spice]'") from error


class SpiceTrajectory(Trajectory):
    """The path of a rig's SPICE table, from time 0 to its duration; before and after it the nearest pose holds.

    Raises
    ------
    TrajectoryError
        Without spiceypy, and where the kernels do not give the path.
    """

    def __init__(self, p: SpicePath) -> None:
        self._p = p
        self._spice = _spiceypy()
        self._last_ns = round(p.duration_s * 1e9)
        for kernel in p.kernels:
            if not Path(kernel).is_file():
                raise TrajectoryError(f"kernel {kernel} is missing: put it there, or correct `kernels`")
        with _LOCK:
            self._start_s = float(self._call("str2et", p.start_utc))
        self._bounds = measured_bounds(self.pose, self.instants_ns)

    @property
    def instants_ns(self) -> list[int]:
        """Instants at which the path is measured, over its whole duration."""
        return [int(t) for t in np.linspace(0, self._last_ns, _MEASURED).astype(np.int64)]

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`; raises TrajectoryError where the kernels have no data."""
        p, et = self._p, self._start_s + min(max(int(t_ns), 0), self._last_ns) * 1e-9
        with _LOCK:
            place, light_s = self._call("spkpos", p.target, et, p.frame, p.aberration, p.observer)
            if not p.camera_frame:
                return Pose(-_KM * place, np.array([1.0, 0.0, 0.0, 0.0]))
            left_s = et if p.aberration == "NONE" else et - light_s
            turn = self._call("pxfrm2", p.camera_frame, p.frame, et, left_s)
        return Pose(-_KM * place, quaternion_of(turn))

    def _call(self, name: str, *arguments: object) -> Any:
        """Call a function of SPICE on this path's kernels; the lock is held."""
        try:
            self._load()
            return getattr(self._spice, name)(*arguments)
        except self._spice.utils.exceptions.SpiceyError as error:
            self._spice.reset()
            raise TrajectoryError(f"SPICE: {self._reason(error)}{self._coverage()}") from error

    @staticmethod
    def _reason(error: Exception) -> str:
        parts = (getattr(error, name, "") for name in ("short", "explain", "long"))
        return " ".join(" ".join(str(part).split()) for part in parts if part) or type(error).__name__

    def _load(self) -> None:
        if [self._p.kernels] == _LOADED:
            return
        _LOADED.clear()
        self._spice.kclear()
        for kernel in self._p.kernels:
            self._spice.furnsh(kernel)
        _LOADED.append(self._p.kernels)

    def _coverage(self) -> str:
        """Return the times for which the kernels have the observer, as a sentence; empty where they cannot be read."""
        spice, found = self._spice, []
        try:
            observer = spice.bods2c(self._p.observer)
            for number in range(spice.ktotal("SPK")):
                window = spice.spkcov(spice.kdata(number, "SPK")[0], observer)
                for k in range(spice.wncard(window)):
                    first, last = (spice.et2utc(et, "ISOC", 3) for et in spice.wnfetd(window, k))
                    found.append(f"{first} to {last}")
        except spice.utils.exceptions.SpiceyError:
            spice.reset()
        return f" (places of {self._p.observer} cover {', '.join(found)} UTC)" if found else ""

    @property
    def speed_bound_m_s(self) -> float:
        """Bound measured at a thousand instants, with a margin."""
        return self._bounds[0]

    @property
    def turn_bound_rad_s(self) -> float:
        """Bound measured likewise."""
        return self._bounds[1]
