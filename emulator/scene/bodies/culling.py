"""Facets that turn their backs are half of any closed body: not asking for them saves half of the work.

Facets are sorted by the direction of their normals into the cells of a cube's faces, so that one test answers for some
hundred of them. A cell is skipped when no facet in it can face the eye: with the cone of its normals (axis a,
half-angle c), the ball around its vertices (centre m, radius r) and the eye at e,

    angle(a, e - m) > 90 degrees + c + asin(r / |e - m|)

The picture is the same to the last bit; GL would have thrown these facets away one by one.

Source of the idea: backface culling by cones of normals, Shirman and Abi-Ezzi 1993.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.mesh import Mesh

if TYPE_CHECKING:
    import moderngl

__all__ = ["Cells", "draw"]

_CELLS_A_SIDE = 4  # of each of the cube's six faces: 96 cells

Floats = npt.NDArray[np.float64]


class Cells:
    """The facets of a mesh by the direction that they face.

    Attributes
    ----------
    faces : (m, 3) int32, the mesh's facets, sorted by cell.
    """

    def __init__(self, mesh: Mesh) -> None:
        normals = _facet_normals(mesh)
        cell = _cube_cell(normals)
        order = np.argsort(cell, kind="stable")
        self.faces = np.ascontiguousarray(mesh.faces[order])
        _, first, count = np.unique(cell[order], return_index=True, return_counts=True)
        self._commands = np.zeros((len(first), 5), np.uint32)  # count, instances, first index, base vertex, instance
        self._commands[:, 0], self._commands[:, 1], self._commands[:, 2] = 3 * count, 1, 3 * first
        groups = [slice(f, f + n) for f, n in zip(first, count, strict=True)]
        sorted_normals = normals[order]
        self._axes = np.array([_unit(sorted_normals[g].sum(axis=0)) for g in groups])
        self._cones = np.array(
            [math.acos(min(1.0, float((sorted_normals[g] @ a).min()))) for g, a in zip(groups, self._axes, strict=True)]
        )
        corners = [mesh.vertices[np.unique(self.faces[g])] for g in groups]
        self._middles = np.array([(c.min(axis=0) + c.max(axis=0)) / 2 for c in corners])
        self._radii = np.array(
            [np.linalg.norm(c - m, axis=1).max() for c, m in zip(corners, self._middles, strict=True)]
        )

    @property
    def buffer_bytes(self) -> int:
        """Room that all drawing commands need."""
        return self._commands.nbytes

    def seen_from(self, eye_m: Floats) -> npt.NDArray[np.uint32]:
        """Return the drawing commands, (n, 5), of cells that may face an eye at (3,), in the body's frame."""
        towards = eye_m - self._middles
        distance = np.linalg.norm(towards, axis=1)
        with np.errstate(divide="ignore", invalid="ignore"):
            spread = np.where(distance > self._radii, np.arcsin(np.minimum(1.0, self._radii / distance)), math.pi)
            angle = np.arccos(np.clip((self._axes * towards).sum(axis=1) / distance, -1, 1))
        return np.asarray(self._commands[~(angle > math.pi / 2 + self._cones + spread + 1e-3)])

    def turned_from(self, direction: Floats) -> npt.NDArray[np.uint32]:
        """Return the drawing commands, (n, 5), of cells that may turn their backs to a far `direction`, (3,)."""
        angle = np.arccos(np.clip(self._axes @ direction, -1, 1))
        return np.asarray(self._commands[~(angle < math.pi / 2 - self._cones - 1e-3)])


def draw(array: moderngl.VertexArray, commands: npt.NDArray[np.uint32], buffer: moderngl.Buffer) -> None:
    """Draw the cells of `commands`."""
    if len(commands):
        buffer.write(np.ascontiguousarray(commands))
        array.render_indirect(buffer, count=len(commands))


def _facet_normals(mesh: Mesh) -> Floats:
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    return _unit(np.cross(b - a, c - a))


def _unit(vectors: Floats) -> Floats:
    return np.asarray(vectors / np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-300))


def _cube_cell(directions: Floats) -> npt.NDArray[np.int64]:
    """Return the cell of the cube around the origin through which each direction, (n, 3), goes."""
    axis = np.abs(directions).argmax(axis=1)
    rows = np.arange(len(directions))
    major = directions[rows, axis]
    side = 2 * axis + (major < 0)
    u, v = (directions[rows, (axis + k) % 3] / np.abs(major) for k in (1, 2))
    across, down = (np.clip(((w + 1) / 2 * _CELLS_A_SIDE).astype(np.int64), 0, _CELLS_A_SIDE - 1) for w in (u, v))
    return np.asarray((side * _CELLS_A_SIDE + down) * _CELLS_A_SIDE + across)
