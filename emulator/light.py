"""Light from scene to sensor: scenes, and the light frames that are drawn of them."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from types import TracebackType
from typing import Literal, Self

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Rays, SceneGeometry

__all__ = ["Light", "LightFrame", "MachineLacks", "PixelLight", "Region", "Scene", "SceneError", "SceneFrames"]

Light = npt.NDArray[np.float32]
"""(height, width) float32, row 0 on top: radiance relative to the sensor's reference level, linear, >= 0."""

PixelLight = Callable[[int, npt.NDArray[np.int64]], tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
"""(t_ns, pixels) -> light and its time derivative, a second, of the pixels row * width + column alone, (n,) each."""


@dataclass(frozen=True)
class Region:
    """Rows and columns of a part of a picture, the last ones not included.

    `boxes`, where given, says more closely where in it: (n, 4) int64, first and last row, first and last column of
    parts that may overlap or be empty, within the picture. They are for what lies scattered, as stars do.
    """

    first_row: int
    last_row: int
    first_column: int
    last_column: int
    boxes: npt.NDArray[np.int64] | None = field(default=None, compare=False)

    @property
    def empty(self) -> bool:
        """Whether it holds no pixel."""
        return self.first_row >= self.last_row or self.first_column >= self.last_column

    @property
    def bounds(self) -> tuple[int, int, int, int]:
        """First row, last row, first column, last column."""
        return self.first_row, self.last_row, self.first_column, self.last_column

    def grown(self, by_px: int, size: tuple[int, int]) -> Region:
        """Return it with `by_px` more pixels on each side, within a picture of `size` = (width, height); no boxes."""
        if self.empty:
            return self
        rows = max(0, self.first_row - by_px), min(size[1], self.last_row + by_px)
        return Region(*rows, max(0, self.first_column - by_px), min(size[0], self.last_column + by_px))


@dataclass(frozen=True, slots=True, eq=False)
class LightFrame:
    """Light on all pixels at one time, as scene, optics and sensor hand it on.

    The arrays belong to the code that made the frame, which may use them again: a frame is valid until the next one
    is drawn (`SceneFrames`). A receiver does not write into them, and copies what it needs longer.

    Attributes
    ----------
    t_ns : int
        Stream time.
    light : (height, width) float32
        Light at `t_ns`, relative to the reference level; values below 0 count as 0.
    rate : (height, width) float32, optional
        Time derivative of the light at `t_ns`, per second, not finite where unknown; None where all is unknown.
    at : PixelLight, optional
        Light of single pixels between the last frame and this one; None where there is no such source.
    changed : Region, optional
        The part of light and rate that may differ from those of the last frame; None: all of it.
    """

    t_ns: int
    light: Light
    rate: Light | None = None
    at: PixelLight | None = None
    changed: Region | None = None


class SceneError(Exception):
    """A scene cannot be built or drawn; the message says what is wrong with it and what would be right."""


class MachineLacks(SceneError):
    """A scene is right, but the machine lacks what draws it; the message says which package has it."""


class Scene(ABC):
    """A picture that changes with time.

    A scene is a context manager: what it holds of the machine (a GL context) is taken in the constructor, in the thread
    that draws, and given back by `close`.
    """

    @property
    @abstractmethod
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""

    @property
    @abstractmethod
    def motion_bound_px_s(self) -> float:
        """No point of the picture moves faster than this, px/s. Infinite where it is not known."""

    @property
    def distance_m(self) -> float:
        """How far away most of what is seen lies; infinite unless a scene knows better. For focus."""
        return math.inf

    @property
    def notes(self) -> tuple[str, ...]:
        """What a user should know of this picture, a sentence each."""
        return ()

    @property
    def painter(self) -> Literal["cpu", "gl"]:
        """What draws: the CPU, unless a scene is one that GL draws."""
        return "cpu"

    @property
    def renderer(self) -> str | None:
        """The name of what draws: GL's own where GL draws; None where a scene gives none."""
        return None

    @property
    def counts(self) -> Mapping[str, int]:
        """Named counts of what happened to the scene during the run, for the summary."""
        return {}

    @abstractmethod
    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at stream time `t_ns` into `out`, (height, width) float32. Depends on nothing else."""

    @property
    def has_rate(self) -> bool:
        """Whether `light_and_rate` gives the exact time derivative of the light.

        A derivative from two pictures is noise at edges (three to five times the signal in scenes of meshes), and makes
        more wrong events than a straight line between single pictures: a scene that has no better one has none.
        """
        return False

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative, per second, into (height, width) float32 arrays.

        The derivative is NaN, not known, unless the scene says that it has one.
        """
        self.light(t_ns, light)
        rate.fill(np.nan)

    @property
    def pixel_light(self) -> PixelLight | None:
        """Tells the light of single pixels at any instant, the same as in a picture but for rounding.

        None, unless a scene knows better: what is drawn is drawn as a whole.
        """
        return None

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return what is known of the pictures beside their light; None where that is nothing.

        `rays` are where the pixels look; None: where the scene's own do. The scene must stay open.
        """
        return None

    @property
    def changed(self) -> Region | None:
        """The part of the last picture that may differ from the one before it in the same arrays; None: anything."""
        return None

    @abstractmethod
    def close(self) -> None:
        """Give back what the scene holds of the machine; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


class SceneFrames:
    """The light frames of a scene, drawn one after another into two arrays that this object owns and uses again.

    Parameters
    ----------
    scene : Scene
        The scene; the caller closes it.
    with_rate : bool
        Whether frames have the time derivative, where the scene has one.
    with_pixel_light : bool
        Whether frames that have the derivative also have the light of single pixels, where the scene has it.

    Attributes
    ----------
    last : LightFrame
        The frame that was drawn last; dark at time 0 before the first.
    count : int
        Frames drawn so far.
    """

    def __init__(self, scene: Scene, *, with_rate: bool, with_pixel_light: bool = False) -> None:
        shape, with_rate = scene.size[::-1], with_rate and scene.has_rate
        rate = np.zeros(shape, np.float32) if with_rate else None
        at = scene.pixel_light if with_rate and with_pixel_light else None
        self.scene = scene
        self.last = LightFrame(0, np.zeros(shape, np.float32), rate, at)
        self.count = 0

    def draw(self, t_ns: int) -> LightFrame:
        """Draw the frame of stream time `t_ns` over the last one, and return it."""
        last = self.last
        if last.rate is None:
            self.scene.light(t_ns, last.light)
        else:
            self.scene.light_and_rate(t_ns, last.light, last.rate)
        self.count += 1
        self.last = LightFrame(t_ns, last.light, last.rate, last.at, self.scene.changed)
        return self.last
