"""Which path a scene's camera is on, for what is carried with it."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from emulator.trajectory.pose import Trajectory
from emulator.trajectory.timescale import Timescale

__all__ = ["HasCameraPath"]


@runtime_checkable
class HasCameraPath(Protocol):
    """A scene whose camera moves on a path.

    Attributes
    ----------
    camera_path : of the camera, on the scene's time.
    path_time : stream time to scene time.
    """

    @property
    def camera_path(self) -> Trajectory:
        """See the class."""

    @property
    def path_time(self) -> Timescale:
        """See the class."""
