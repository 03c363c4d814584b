"""What a scene is to the sensor: light at any instant, and how fast the picture moves."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

__all__ = ["Light", "MachineLacks", "PixelLight", "Region", "Scene", "SceneError"]

Light = npt.NDArray[np.float32]
"""(height, width) float32, row 0 on top: radiance relative to the sensor's reference level, linear, >= 0."""

PixelLight = Callable[[int, npt.NDArray[np.int64]], tuple[npt.NDArray[np.float32], npt.NDArray[np.float32]]]
"""(t_ns, pixels) -> light and its time derivative, a second, of the pixels row * width + column alone, (n,) each."""


@dataclass(frozen=True)
class Region:
    """Rows and columns of a part of a picture, the last ones not included."""

    first_row: int
    last_row: int
    first_column: int
    last_column: int

    @property
    def empty(self) -> bool:
        """Whether it holds no pixel."""
        return self.first_row >= self.last_row or self.first_column >= self.last_column

    def grown(self, by_px: int, size: tuple[int, int]) -> Region:
        """Return it with `by_px` more pixels on each side, within a picture of `size` = (width, height)."""
        if self.empty:
            return self
        rows = max(0, self.first_row - by_px), min(size[1], self.last_row + by_px)
        return Region(*rows, max(0, self.first_column - by_px), min(size[0], self.last_column + by_px))


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
    def renderer(self) -> str | None:
        """The name of what draws, in GL's words; None where no GL is used."""
        return None

    @property
    def counts(self) -> Mapping[str, int]:
        """Named counts of what happened to the scene during the run, for the summary."""
        return {}

    @abstractmethod
    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at stream time `t_ns` into `out`, (height, width) float32. Depends on nothing else."""

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the light at several times, each into its own picture, as so many calls of `light` would.

        Scenes that are drawn begin all before they wait for the first.
        """
        for t_ns, out in zip(times_ns, outs, strict=True):
            self.light(t_ns, out)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative, per second, into (height, width) float32 arrays.

        Unless a scene knows better, both come of two pictures a twentieth of a pixel of motion before and after: their
        mean misses the light by a thousandth of what a straight line over half a pixel would, and two pictures cost
        less than the many that slopes save.
        """
        apart_ns = self._apart_ns(t_ns)
        self.lights((t_ns - apart_ns, t_ns + apart_ns), (rate, light))
        before = rate.copy()
        np.subtract(light, before, out=rate)
        rate *= np.float32(0.5e9 / apart_ns)
        light += before
        light *= np.float32(0.5)

    @property
    def pixel_light(self) -> PixelLight | None:
        """Tells the light of single pixels at any instant, the same as in a picture but for rounding.

        None, unless a scene knows better: what is drawn is drawn as a whole.
        """
        return None

    @property
    def changed(self) -> Region | None:
        """The part of the last picture that may differ from the one before it in the same arrays; None: anything."""
        return None

    def _apart_ns(self, t_ns: int = 0) -> int:
        """Time in which the picture at `t_ns` moves by a twentieth of a pixel, within 20 us to 2 ms, ns."""
        motion = self._motion_px_s(t_ns)
        return round(min(max(0.05e9 / motion, 20_000), 2_000_000)) if motion > 0 else 2_000_000

    def _motion_px_s(self, t_ns: int) -> float:
        """How fast the picture moves at `t_ns`: as its bound says, unless a scene knows better."""
        return self.motion_bound_px_s

    @abstractmethod
    def close(self) -> None:
        """Give back what the scene holds of the machine; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
