"""Base of the scenes of a world, for the CPU and for GL: a camera on its path before bodies or ground."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from emulator.geometry.camera import Pinhole
from emulator.gl.context import QUICK_LOOK, Painter
from emulator.gl.render_target import RenderTarget
from emulator.light import Light, Region, Scene
from emulator.trajectory.live import ComingPoses
from emulator.trajectory.pose import Timescale, Trajectory

if TYPE_CHECKING:
    import moderngl


class World(Protocol):
    """A world before a camera.

    Attributes
    ----------
    camera : the camera's path, on the scene's time.
    time : stream time to scene time.
    motion_bound_px_s : upper bound of the speed of all points in the light frame.
    distance_m : distance of the nearest object.
    """

    pinhole: Pinhole
    camera: Trajectory
    time: Timescale
    motion_bound_px_s: float
    distance_m: float

    @property
    def paths(self) -> Sequence[Trajectory]:
        """Paths of the bodies."""

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of poses received from outside."""

    def notes(self, first_frame: Light) -> tuple[str, ...]:
        """Return remarks for the user; `first_frame` is the light at time 0."""

    def close(self) -> None:
        """Close the ports of live poses."""


W = TypeVar("W", bound=World)


class WorldScene(Scene, Generic[W]):
    """A scene of `world`, drawn by the CPU unless a subclass draws by GL."""

    renderer: str | None = "the CPU, exact coverage"
    motion_bound_px_s = math.inf

    def __init__(self, world: W) -> None:
        self._world = world
        self.camera_path, self.path_time = world.camera, world.time
        self.size, self.distance_m = world.pinhole.size, world.distance_m
        self.motion_bound_px_s = world.motion_bound_px_s
        self.is_known_ahead = not any(isinstance(path, ComingPoses) for path in (world.camera, *world.paths))

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the world and on the light at time 0."""
        first_frame = np.zeros(self.size[::-1], np.float32)
        self.light(0, first_frame)
        return self._world.notes(first_frame)

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of poses received from outside."""
        return self._world.counts

    def close(self) -> None:
        """Close the ports of live poses; a second call does nothing."""
        self._world.close()


class GlScene(WorldScene[W]):
    """A scene of `world`, drawn by GL into `render_target`."""

    painter: Painter = "gl"

    def __init__(self, world: W, render_target: RenderTarget) -> None:
        super().__init__(world)
        self._render_target = render_target
        self.renderer = render_target.renderer

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks, that it is a quick look first."""
        return (QUICK_LOOK, *super().notes)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the radiance at `t_ns` into `out`, (height, width) float32."""
        render, region = self._drawing(t_ns)
        self._render_target.draw(render, out, region)

    @abstractmethod
    def _drawing(self, t_ns: int) -> tuple[Callable[[moderngl.Context], None], Region | None]:
        """Return a function that draws the scene at `t_ns`, and the region that it may touch, None for the whole frame.

        All errors are raised here, none while drawing.
        """

    def close(self) -> None:
        """Release the GL context, and close the ports; a second call does nothing."""
        self._render_target.close()
        super().close()
