"""Smooth ground of a body, where fine material gathers: the seas of Itokawa.

It is the part of the surface low in the body's gravity and even in the shape model. The smooth fifth of Itokawa,
Muses-C and Sagamihara, holds pebbles that moved down to where the potential is low (Fujiwara et al. 2006, Science 312,
1330; Miyamoto et al. 2007, Science 316, 1011). From 8 to 32 m the roughness of Itokawa follows its potential for the
same reason (Susorney et al. 2019, Icarus 325, 141). The potential alone does not find Sagamihara, which is a basin of
higher ground; the model's facets alone find the floors of craters. The border is taken as sharp.

    height       the potential of gravity, the density the same everywhere
    unevenness   the spread of the directions of the facets within some facets: its square is 1 - |mean normal|^2

Both are ranks by area, 0 to 1, and count the same. Left out: the body's rotation, a tenth of the potential's range on
Itokawa, and the sources and paths of the material.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

import numpy as np

from emulator.scene.bodies.albedo import smooth_step
from emulator.scene.bodies.compiled import dot, entry, minus, row
from emulator.scene.bodies.mesh import Mesh, facet_vectors, group_means
from firmware_protocol.events import Floats

_SHELLS = 6  # point masses along each cone from the origin to a facet
_SHORE = 0.01  # of the surface, the part over which smooth ground passes into rough ground, on either side
_RINGS = 8  # times that normals, and then their spread, are averaged with the vertices around


def smooth_ground(mesh: Mesh, coarse: Mesh, share: float) -> Callable[[Floats], Floats]:
    """Return the function that gives 1 on smooth ground, 0 on rough ground, a short ramp between, for places (n, 3) m.

    `coarse` is the body with at most some thousand facets, for its gravity; `share` of the surface is smooth.
    """
    if share <= 0:
        return lambda places: np.zeros(len(places))
    sizes = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    areas: Floats = np.bincount(mesh.faces.ravel(), np.repeat(sizes, 3), len(mesh.vertices)).astype(np.float64)
    height = _between(coarse.vertices, potential(coarse, coarse.vertices), mesh.vertices, 1e-3 * coarse.radius_m)
    order = _rank(_rank(height, areas) + _rank(_unevenness(mesh), areas), areas)

    def smoothness(places: Floats) -> Floats:
        rank = _between(mesh.vertices, order, places, 1e-6 * mesh.radius_m)
        return smooth_step((share + _SHORE - rank) / (2 * _SHORE))

    return smoothness


def _between(points: Floats, values: Floats, places: Floats, soft_m: float) -> Floats:
    """Return values at places, means of those at the nearest points with weights by the square of the distance."""
    from scipy.spatial import cKDTree  # loaded where it is used, as in `regolith`

    distance, nearest = cKDTree(points).query(places, 6)
    weights = 1 / (distance + soft_m) ** 2
    return np.asarray((weights * values[nearest]).sum(axis=1) / weights.sum(axis=1))


def _rank(values: Floats, areas: Floats) -> Floats:
    """Return the share of the area with smaller values, for each vertex."""
    order = np.argsort(values, kind="stable")
    below = np.cumsum(areas[order])
    out = np.empty(len(values))
    out[order] = (below - areas[order] / 2) / below[-1]
    return out


def _unevenness(mesh: Mesh) -> Floats:
    """Return the sine of the spread of the facets' directions around each vertex, (n,)."""
    around = _mean_around(mesh)
    facets = facet_vectors(mesh.vertices, mesh.faces)
    facets /= np.maximum(np.linalg.norm(facets, axis=1, keepdims=True), 1e-300)
    corners, count = mesh.faces.ravel(), np.bincount(mesh.faces.ravel(), minlength=len(mesh.vertices))
    means = group_means(np.repeat(facets, 3, axis=0), corners, np.maximum(count, 1))
    for _ in range(_RINGS):
        means = around @ means
    spread = np.sqrt(np.maximum(1 - (means**2).sum(axis=1), 0))
    for _ in range(_RINGS):
        spread = around @ spread
    return np.asarray(spread)


def _mean_around(mesh: Mesh) -> Any:
    """Return the sparse matrix (n, n) that gives each vertex the mean of itself and of those it shares a side with."""
    from scipy.sparse import coo_matrix, diags_array, eye_array

    n = len(mesh.vertices)
    ends = np.concatenate([mesh.faces[:, [k, (k + 1) % 3]] for k in range(3)])
    ends = np.concatenate([ends, ends[:, ::-1]])
    sides = coo_matrix((np.ones(len(ends)), ends.T), (n, n)).tocsr()
    sides.data[:] = 1.0  # a side belongs to two facets
    with_itself = sides + eye_array(n)
    return diags_array(1 / np.asarray(with_itself.sum(axis=1)).ravel()) @ with_itself


def potential(body: Mesh, places: Floats) -> Floats:
    """Return the potential of gravity at places, (n,), over that of the same mass at a distance of 1 m.

    Each facet and the origin span a cone; its volume, with a sign, is divided into shells with a point mass each.
    """
    corners = body.vertices[body.faces]
    volumes = np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])) / 6
    edges = np.arange(_SHELLS + 1) / _SHELLS
    parts = np.diff(edges**3)
    middles = 0.75 * np.diff(edges**4) / parts  # of the mass of a shell, as a share of the way to the facet
    masses = (parts[:, None] * volumes).ravel() / volumes.sum()
    points = (middles[:, None, None] * corners.mean(axis=1)).reshape(-1, 3)
    soft = np.tile(np.linalg.norm(np.ptp(corners, axis=1), axis=1) ** 2 / 16, _SHELLS)
    out = np.empty(len(places))
    _add_up(points, masses, soft, places, out)
    return out


@entry
def _add_up(points: Floats, masses: Floats, soft: Floats, places: Floats, out: Floats) -> None:
    """Write the potential of masses at points, each spread over an area `soft`, m2, at places."""
    for k in range(len(places)):
        total = 0.0
        for i in range(len(points)):
            away = minus(row(points, i), row(places, k))
            total -= masses[i] / math.sqrt(dot(away, away) + soft[i])
        out[k] = total
