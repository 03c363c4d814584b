"""A tree of boxes around triangles, built once for each rigid body, for rays and cones from anywhere.

The tree is a complete binary tree in a heap: node 1 is the root, node i has the children 2 i and 2 i + 1, and the last
level holds the leaves. Triangles are split at the median of their middles along the longest side of their box. A walk
goes through it from left to right and needs no stack: after node i comes 2 i, or `after(i)` where i is left out.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numba
import numpy as np
import numpy.typing as npt

__all__ = ["TriangleTree", "after", "build_tree"]

_LEAF = 4  # triangles

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class TriangleTree:
    """Triangles in the order of the tree's leaves.

    Attributes
    ----------
    boxes : (2 leaves, 6) float64, m, the middle and half the sides of each node; row 0 is not used.
    starts : (leaves + 1,) int32, the first triangle of each leaf.
    corners : (m, 9) float64, m, the corners of each triangle, counter-clockwise as seen from outside.
    planes : (m, 4) float64, unit normal and offset: a point x is outside a triangle's plane where n.x > offset, m.
    """

    boxes: Floats
    starts: npt.NDArray[np.int32]
    corners: Floats
    planes: Floats

    @property
    def arrays(self) -> tuple[Floats, npt.NDArray[np.int32], Floats, Floats]:
        """The arrays for a kernel."""
        return self.boxes, self.starts, self.corners, self.planes

    @property
    def middle_m(self) -> Floats:
        """The middle of the box around all, (3,)."""
        return self.boxes[1, :3]

    @property
    def radius_m(self) -> float:
        """No triangle reaches farther from the middle."""
        return float(np.linalg.norm(self.boxes[1, 3:]))


def build_tree(triangles: Floats) -> TriangleTree:
    """Return the tree of (m, 3, 3) corners, m; at least one."""
    depth = max(0, math.ceil(math.log2(max(len(triangles) / _LEAF, 1.0))))
    starts = np.array([round(k * len(triangles) / 2**depth) for k in range(2**depth + 1)], np.int32)
    order = np.arange(len(triangles))
    middles = triangles.mean(axis=1)
    for level in range(depth):
        step = 2 ** (depth - level)
        for first in range(0, 2**depth, step):
            low, split, high = starts[[first, first + step // 2, first + step]]
            order[low:high] = _halved(middles, order[low:high], split - low)
    ordered = np.ascontiguousarray(triangles[order])
    return TriangleTree(_boxes(ordered, starts), starts, ordered.reshape(-1, 9), _planes(ordered))


def _halved(middles: Floats, part: npt.NDArray[np.intp], split: int) -> npt.NDArray[np.intp]:
    """Return a part of the order with its `split` lowest first, along the longest side."""
    where = middles[part]
    along = where[:, int(np.argmax(np.ptp(where, axis=0)))]
    return part[np.argpartition(along, split)] if 0 < split < len(part) else part


def _boxes(triangles: Floats, starts: npt.NDArray[np.int32]) -> Floats:
    leaves = len(starts) - 1
    low, high = np.empty((2 * leaves, 3)), np.empty((2 * leaves, 3))
    low[0] = high[0] = 0.0
    low[leaves:] = np.minimum.reduceat(triangles.min(axis=1), starts[:-1])
    high[leaves:] = np.maximum.reduceat(triangles.max(axis=1), starts[:-1])
    for node in range(leaves - 1, 0, -1):
        low[node] = np.minimum(low[2 * node], low[2 * node + 1])
        high[node] = np.maximum(high[2 * node], high[2 * node + 1])
    return np.hstack([(low + high) / 2, (high - low) / 2])


def _planes(triangles: Floats) -> Floats:
    """Return unit normals and offsets; a triangle without area has the normal 0 and so no outside."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    return np.column_stack([normals, (normals * triangles.mean(axis=1)).sum(axis=1)])


@numba.njit(error_model="numpy")
def after(node: int) -> int:
    """Return the node to look at after `node` and all below it; 1 when the walk is over."""
    node += 1
    while node % 2 == 0:
        node >>= 1
    return node
