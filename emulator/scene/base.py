"""What a scene is to the sensor: light at any instant, and how fast the picture moves."""

from __future__ import annotations

from abc import ABC, abstractmethod
from types import TracebackType
from typing import Self

import numpy as np
import numpy.typing as npt

__all__ = ["Light", "MachineLacks", "Scene", "SceneError"]

Light = npt.NDArray[np.float32]
"""(height, width) float32, row 0 on top: radiance relative to the sensor's reference level, linear, >= 0."""


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

    @abstractmethod
    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at stream time `t_ns` into `out`, (height, width) float32. Depends on nothing else."""

    @abstractmethod
    def close(self) -> None:
        """Give back what the scene holds of the machine; a second call does nothing."""

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
