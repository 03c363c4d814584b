"""What is true of a picture beside its light: how far each pixel's point is, how it moves, and on which body it lies.

    depth     along the boresight, m; infinite where there is nothing but sky
    flow      of the point that the pixel's middle shows, px/s: columns to the right, rows down
    labels    0 for the sky, k for the k-th of `SceneGeometry.names`

A scene that knows this has a `SceneGeometry`. A lens that bends lines asks for one along rays of its own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole

__all__ = ["Given", "Placed", "Rays", "SceneGeometry", "Seen"]

Floats = npt.NDArray[np.float64]

Given = Literal["poses", "depth", "flow", "labels"]


@dataclass(frozen=True, eq=False)
class Rays:
    """Where pixels look: the places of their middles in the picture of a camera without distortion.

    Attributes
    ----------
    columns, rows : (height, width) float64, px.
    bend : (height, width, 3), how what moves in that picture moves on the chip: dx'/dx, dx'/dy = dy'/dx, dy'/dy; None
        where the two are one.
    """

    columns: Floats
    rows: Floats
    bend: Floats | None = None

    @classmethod
    def straight(cls, camera: Pinhole) -> Rays:
        """Return the middles of the pixels of a camera without distortion."""
        columns, rows = np.meshgrid(np.arange(camera.width) + 0.5, np.arange(camera.height) + 0.5)
        return cls(columns, rows)


@dataclass(frozen=True, eq=False)
class Seen:
    """Room for what is seen at one instant.

    Attributes
    ----------
    depth : (height, width) float32, m.
    flow : (height, width, 2) float32, px/s.
    labels : (height, width) uint16.
    """

    depth: npt.NDArray[np.float32]
    flow: npt.NDArray[np.float32]
    labels: npt.NDArray[np.uint16]

    @classmethod
    def of(cls, width: int, height: int) -> Seen:
        """Return room for a picture."""
        depth, flow = np.full((height, width), np.inf, np.float32), np.zeros((height, width, 2), np.float32)
        return cls(depth, flow, np.zeros((height, width), np.uint16))


@dataclass(frozen=True, eq=False)
class Placed:
    """The poses of camera and bodies in the world.

    Attributes
    ----------
    camera_m, q_world_from_camera : (3,) m and (4,) unit quaternion, scalar first.
    bodies_m, q_world_from_bodies : (bodies, 3) and (bodies, 4).
    """

    camera_m: Floats
    q_world_from_camera: Floats
    bodies_m: Floats
    q_world_from_bodies: Floats


class SceneGeometry(ABC):
    """What a scene knows of its pictures beside their light.

    Attributes
    ----------
    names : of what is seen; label k is names[k - 1].
    gives : what there is: "poses", "depth", "flow", "labels".
    """

    names: tuple[str, ...]
    gives: frozenset[Given]

    @abstractmethod
    def look(self, t_ns: int, out: Seen) -> None:
        """Write what is seen at stream time `t_ns`; only the arrays that `gives` names are written."""

    def places(self, t_ns: int) -> Placed | None:
        """Return the poses at stream time `t_ns`; None where there are none."""
        return None
