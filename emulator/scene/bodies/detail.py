"""A mesh with as much detail as is seen.

Facets smaller than the eye resolves cost as much as large ones. Here vertices are gathered in cells of a grid: each
cell keeps one vertex, at the mean place of its own and with the mean of their *fine* normals, so shading keeps the
slopes that the fine model has at the scale of the cell; facets whose corners fall together vanish. With cells of half a
pixel nothing is lost that a pixel's mean would show.

Source of the method: vertex clustering, Rossignac and Borrel 1993, Multi-resolution 3D approximations.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.mesh import Mesh

__all__ = ["coarser", "facet_size_m", "flat"]


def facet_size_m(mesh: Mesh) -> float:
    """Return the side of a square as large as the mean facet, m."""
    return float(np.sqrt(mesh.area_m2 / len(mesh.faces)))


def coarser(mesh: Mesh, cell_m: float) -> Mesh:
    """Return the mesh with one vertex a cell of `cell_m`; the mesh itself where that spares less than a tenth."""
    cells = np.floor(mesh.vertices / cell_m).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, first, cell, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    corners = cell[mesh.faces]
    a, b, c = corners.T
    kept = _distinct(corners[(a != b) & (b != c) & (c != a)])
    albedo = None if mesh.albedo is None else _mean(mesh.vertex_albedo[:, None], cell, count)[kept, 0]
    if len(kept) > 0.9 * len(mesh.faces) or not len(kept):
        return mesh
    vertices = _mean(mesh.vertices, cell, count)
    normals = _mean(mesh.normals, cell, count)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    cancelled = length < 1e-6  # both sides of a thin sheet in one cell: any of its normals will do
    normals = np.where(cancelled, mesh.normals[first], normals) / np.where(cancelled, 1.0, np.maximum(length, 1e-6))
    facets = kept.astype(np.int32)
    return Mesh(vertices, facets, normals, mesh.dropped_facets, mesh.open_edges, mesh.was_inside_out, albedo)


def flat(mesh: Mesh) -> Mesh:
    """Return the mesh with corners of its own for each facet, their normals the facet's."""
    corners = mesh.vertices[mesh.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    faces = np.arange(3 * len(corners), dtype=np.int32).reshape(-1, 3)
    vertices = corners.reshape(-1, 3)
    normals = np.repeat(normals, 3, axis=0)
    return Mesh(vertices, faces, normals, mesh.dropped_facets, mesh.open_edges, mesh.was_inside_out, mesh.albedo)


def _mean(
    values: npt.NDArray[np.float64], cell: npt.NDArray[np.intp], count: npt.NDArray[np.intp]
) -> npt.NDArray[np.float64]:
    sums = np.column_stack([np.bincount(cell, column, len(count)) for column in values.T])
    return np.asarray(sums / count[:, None])


def _distinct(corners: npt.NDArray[np.intp]) -> npt.NDArray[np.intp]:
    """Return the facets without repetitions; which corner comes first does not matter."""
    turn = corners.argmin(axis=1)
    rows = np.arange(len(corners))
    turned = np.column_stack([corners[rows, (turn + k) % 3] for k in range(3)])
    return np.asarray(np.unique(turned, axis=0))
