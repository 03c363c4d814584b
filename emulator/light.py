"""Light from scene to sensor: scenes, and the light frames that are drawn of them."""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Rays, SceneGeometry, Seen
from transports import Closing

Light = npt.NDArray[np.float32]
"""(height, width) float32, row 0 on top: radiance relative to the sensor's reference level, linear, >= 0."""

PixelLight = Callable[[int, npt.NDArray[np.int64]], tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
"""(t_ns, pixels) -> light and its time derivative, a second, of the pixels row * width + column only, (n,) each."""


@dataclass(frozen=True)
class Region:
    """Rows and columns of a part of a light frame, the last ones not included.

    `boxes`, where given, limits the part further: (n, 4) int64, first and last row, first and last column of boxes that
    may overlap or be empty, within the frame. They are for scattered objects, such as stars.
    """

    first_row: int
    last_row: int
    first_column: int
    last_column: int
    boxes: npt.NDArray[np.int64] | None = field(default=None, compare=False)

    @property
    def empty(self) -> bool:
        """True: the region contains no pixel."""
        return self.first_row >= self.last_row or self.first_column >= self.last_column

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First row, last row, first column, last column."""
        return self.first_row, self.last_row, self.first_column, self.last_column

    def union(self, other: Region) -> Region:
        """Return the smallest region that holds both; no boxes."""
        if self.empty or other.empty:
            return other if self.empty else self
        first_row, first_column = min(self.first_row, other.first_row), min(self.first_column, other.first_column)
        last_row, last_column = max(self.last_row, other.last_row), max(self.last_column, other.last_column)
        return Region(first_row, last_row, first_column, last_column)

    def grown(self, by_px: int, size: tuple[int, int]) -> Region:
        """Return the region with `by_px` more pixels a side, within a frame of `size` = (width, height); no boxes."""
        if self.empty:
            return self
        rows = max(0, self.first_row - by_px), min(size[1], self.last_row + by_px)
        return Region(*rows, max(0, self.first_column - by_px), min(size[0], self.last_column + by_px))


NOTHING = Region(0, 0, 0, 0)


@dataclass(frozen=True, slots=True, eq=False)
class LightFrame:
    """Light on all pixels at one time, as scene, optics and sensor pass it on.

    The arrays belong to the code that made the frame, which may use them again: a frame is valid until the next one
    is drawn (`SceneFrames`). A receiver does not write into them, and copies what it needs longer.

    Attributes
    ----------
    t_ns : stream time.
    light : (height, width) float32 at `t_ns`, relative to the reference level; values below 0 count as 0.
    rate : (height, width) float32, time derivative of the light at `t_ns`, per second, not finite where unknown; None
        where all is unknown.
    at : light of single pixels between the last frame and this one; None where there is no such source.
    at_is_moved : True: `at` moves drawings, with errors of its own; finer steps than these errors would be in vain.
    changed : part of light and rate that may differ from those of the last frame; None: all of it.
    """

    t_ns: int
    light: Light
    rate: Light | None = None
    at: PixelLight | None = None
    changed: Region | None = None
    at_is_moved: bool = False


class SceneError(Exception):
    """A scene cannot be built or drawn; the message names the fault and the remedy."""


class MachineLacks(SceneError):
    """A scene is valid, but the machine lacks software to draw it; the message names the missing package."""


class SceneEnded(SceneError):
    """A scene has come to its regular end: there is no more light to draw."""


class Scene(Closing):
    """Light that changes with time.

    A scene is a context manager: it acquires resources of the machine (a GL context) in the constructor, in the thread
    that draws, and releases them in `close`.
    """

    changed: Region | None = None
    """The part of the last frame that may differ from the one before it in the same arrays; None: all of it."""

    size: tuple[int, int]
    """(width, height) in pixels."""

    distance_m: float = math.inf
    """Distance of most visible objects, for focus; infinite unless a scene gives a value."""

    painter: Literal["cpu", "gl"] = "cpu"
    """The painter: the CPU, unless GL draws the scene."""

    renderer: str | None = None
    """Name of the renderer: GL's own where GL draws; None where a scene gives none."""

    is_known_ahead: bool = False
    """True: any instant can be drawn at any time, and `geometry` has the flow: no pose comes from outside."""

    refines: bool = False
    """True: the light of single pixels is so cheap that undersampled steps are refined with it, where it is given."""

    has_rate: bool = False
    """True: `light_and_rate` gives the exact time derivative of the light.

    A derivative from two light frames is noise at edges (three to five times the signal in scenes of meshes), and makes
    more wrong events than a straight line between single frames: a scene without a better one gives none.
    """

    @property
    @abstractmethod
    def motion_bound_px_s(self) -> float:
        """Upper bound of the speed of all points in the light frame, px/s. Infinite where it is not known."""

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks for the user on this scene, a sentence each."""
        return ()

    @property
    def counts(self) -> Mapping[str, int]:
        """Named counts of the scene during the run, for the summary."""
        return {}

    def stop(self) -> None:  # most scenes wait for no other program
        """Limit the time of the present light frame to a second, where another program draws it; for a signal handler.

        A frame that takes longer ends by SceneEnded.
        """

    @abstractmethod
    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at stream time `t_ns` into `out`, (height, width) float32. It depends on `t_ns` only."""

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative, per second, into (height, width) float32 arrays.

        The derivative is NaN, not known, unless `has_rate` is True.
        """
        self.light(t_ns, light)
        rate.fill(np.nan)

    @property
    def pixel_light(self) -> PixelLight | None:
        """Function that gives the light of single pixels at any instant, equal to that of a frame but for rounding.

        None, unless a scene can draw single pixels, and for the step to the last frame this is of use.
        """
        return None

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene beside its light; None where it gives none.

        `rays` are those of the pixels; None: the scene's own. The scene must stay open.
        """
        return None

    def flow(self, out: Seen) -> bool:
        """Write flow, and labels above 0 for surfaces, of the frame that was drawn last, if that saves a look.

        Return whether it did so; else `geometry` has them.
        """
        del out
        return False

    @abstractmethod
    def close(self) -> None:
        """Release the resources of the scene; a second call does nothing."""


class OtherLight(Scene):
    """A scene with the light of another one, `scene`, changed; all else is that scene's, which is closed with this."""

    def __init__(self, scene: Scene) -> None:
        self.scene = scene
        self.size, self.distance_m = scene.size, scene.distance_m
        self.painter, self.renderer = scene.painter, scene.renderer
        self.has_rate, self.is_known_ahead = scene.has_rate, scene.is_known_ahead

    @property
    def motion_bound_px_s(self) -> float:
        """Upper bound of the speed of all points in the scene."""
        return self.scene.motion_bound_px_s

    @property
    def notes(self) -> tuple[str, ...]:
        """Remarks on the scene."""
        return self.scene.notes

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of the scene during the run."""
        return self.scene.counts

    def stop(self) -> None:
        """Limit the time of the present light frame of the scene."""
        self.scene.stop()

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene."""
        return self.scene.geometry(rays)

    def flow(self, out: Seen) -> bool:
        """Write the flow of the scene's last frame, if that saves a look."""
        return self.scene.flow(out)

    def close(self) -> None:
        """Close the scene."""
        self.scene.close()


class LastArrays:
    """The arrays that a scene wrote last: those still hold its frame, so that only what changed is written again."""

    def __init__(self) -> None:
        self._arrays: tuple[Light | None, ...] = ()

    def are(self, *arrays: Light | None) -> bool:
        """Return whether these were the last ones; from now on they are."""
        last, self._arrays = self._arrays, arrays
        return len(arrays) == len(last) and all(a is b for a, b in zip(arrays, last, strict=True))


class SceneFrames:
    """The light frames of a scene, drawn one after another into two arrays that this object owns and uses again.

    Parameters
    ----------
    scene : the scene; the caller closes it.
    with_rate : True: frames have the time derivative, where the scene has one.
    with_pixel_light : True: frames with the derivative also have the light of single pixels, where the scene has it.

    Attributes
    ----------
    last : the frame that was drawn last; dark at time 0 before the first.
    count : frames drawn so far.
    """

    def __init__(self, scene: Scene, *, with_rate: bool, with_pixel_light: bool = False) -> None:
        shape, with_rate = scene.size[::-1], with_rate and scene.has_rate
        rate = np.zeros(shape, np.float32) if with_rate else None
        self.scene = scene
        self._has_pixel_light = with_rate and with_pixel_light
        at = scene.pixel_light if self._has_pixel_light else None
        self.last = LightFrame(0, np.zeros(shape, np.float32), rate, at, None, scene.refines)
        self.count = 0

    def draw(self, t_ns: int) -> LightFrame:
        """Draw the frame of stream time `t_ns` over the last one, and return it."""
        last = self.last
        if last.rate is None:
            self.scene.light(t_ns, last.light)
        else:
            self.scene.light_and_rate(t_ns, last.light, last.rate)
        self.count += 1
        at = self.scene.pixel_light if self._has_pixel_light else None
        self.last = LightFrame(t_ns, last.light, last.rate, at, self.scene.changed, self.scene.refines)
        return self.last
