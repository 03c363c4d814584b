"""Low ground of a body by its own gravity, where fine material gathers: the smooth seas of Itokawa.

Height is by the potential of the body's gravity, its density the same everywhere. Itokawa's smooth ground, Muses-C and
Sagamihara, lies where the potential is low and takes about a fifth of the surface (Fujiwara et al. 2006, Science 312,
1330; Demura et al. 2006, Science 312, 1347). Left out: the body's rotation, which changes heights, not the order of
neck and ends, and the sources and paths of the material.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.mesh import Mesh

__all__ = ["low_ground", "potential"]

Floats = npt.NDArray[np.float64]

_SHELLS = 6  # point masses along each cone from the origin to a facet
_AT_ONCE = 500  # places of one array operation
_SHORE = 0.06  # of the surface, the part over which low ground passes into high ground, on either side


def low_ground(mesh: Mesh, coarse: Mesh, places: Floats, share: float) -> Floats:
    """Return 1 on the low ground, 0 on high ground, smooth between, for places (n, 3) m on the surface.

    Parameters
    ----------
    coarse : the body with at most some thousand facets, for its gravity.
    share : of the surface that is low.
    """
    from scipy.spatial import cKDTree

    if share <= 0:
        return np.zeros(len(places))
    values = potential(coarse, coarse.vertices)
    tree = cKDTree(coarse.vertices)

    def at(points: Floats) -> Floats:
        distance, which = tree.query(points, 6)
        weights = 1 / (distance + 1e-3 * coarse.radius_m) ** 2
        return np.asarray((weights * values[which]).sum(axis=1) / weights.sum(axis=1))

    order = np.sort(at(mesh.vertices[mesh.faces].mean(axis=1)))
    rank = np.searchsorted(order, at(places)) / len(order)
    x = np.clip((share + _SHORE - rank) / (2 * _SHORE), 0, 1)
    return np.asarray(x * x * (3 - 2 * x))


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
    for k in range(0, len(places), _AT_ONCE):
        some = places[k : k + _AT_ONCE]
        squares = (some**2).sum(axis=1)[:, None] + (points**2).sum(axis=1) - 2 * some @ points.T
        out[k : k + _AT_ONCE] = -(masses / np.sqrt(np.maximum(squares, 0) + soft)).sum(axis=1)
    return out
