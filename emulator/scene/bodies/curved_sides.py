"""Sides of smooth bodies that are cut in the middle where flat facets would be seen to be flat.

A smooth surface is curved between its vertices, and a side between two of them bends by up to an eighth of its length
times the difference of the normals. That shows in two places alone:

    where the Sun rises or sets    a chord casts another shadow than the curve, and the light is not linear
    on the outline                 the chord lies inside it

There, in each light frame anew, sides that bend by more than BEND_PX are cut, and the new vertex lies on the curve. All
other facets stay whole: beside cutting all these sides it is a fifth of the new facets for most of the gain. Shadows
are those of the surface with all sides cut.

The curve is a cubic through both vertices, along their tangent planes. Source: Vlachos et al. 2001, Curved PN
triangles.
"""

from __future__ import annotations

import dataclasses
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import entry
from emulator.scene.bodies.lit_surface import Surface, lit_surface, middles_of, split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.sun_rays import Window, depth_in

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int32]

BEND_PX = 0.06
"""Bend of a side at the body's closest that is not seen, pixels."""

_OUT_OF_FRAME = -2.0
_DARKEST = -0.5  # cosine of incidence: from there on no corner of a facet is lit


class Sides(NamedTuple):
    """Sides of a surface that may be cut.

    Attributes
    ----------
    ends : (n,  2), the vertices at both ends.
    turns : (n,), the difference of their normals: a side whose cosine of incidence is less may meet the terminator.
    """

    ends: Numbers
    turns: Floats


def split_round(mesh: Mesh, split: Bools) -> Mesh:
    """Return the mesh with the sides of `split`, (m, 3), cut in the middle of their curves."""
    sides, _ = middles_of(mesh, split)
    cut = split_sides(mesh, split)
    vertices = cut.vertices.copy()
    vertices[len(mesh.vertices) :] += _bends(mesh, sides)
    return dataclasses.replace(cut, vertices=vertices)


def _bends(mesh: Mesh, sides: Numbers) -> Floats:
    """Return the way from the middle of each chord to that of its curve, (n, 3) m; `sides` are vertices, (n, 2)."""
    ends, normals = mesh.vertices[sides], mesh.normals[sides]
    along = (ends[:, 1] - ends[:, 0])[:, None]
    turned = (along * normals).sum(axis=2, keepdims=True) * normals
    return np.asarray((turned[:, 1] - turned[:, 0]) / 8)


def with_middles(mesh: Mesh, least_m: float) -> tuple[Surface, Sides, Mesh]:
    """Return a smooth surface with points in the middle of sides that bend by more than `least_m`.

    Returns
    -------
    The surface, whose last vertices are these points; its sides, in the same order; and the mesh with all of them cut.
    """
    everywhere = np.ones(mesh.faces.shape, np.bool_)
    sides, number = middles_of(mesh, everywhere)
    split = (np.linalg.norm(_bends(mesh, sides), axis=1) > least_m)[number].reshape(mesh.faces.shape)
    cut = split_round(mesh, split)
    sides, number = middles_of(mesh, split)
    middles = np.full(mesh.faces.shape, -1, np.int32)
    middles[split] = len(mesh.vertices) + number
    whole, fine = lit_surface(mesh, smooth=True), lit_surface(cut, smooth=True)
    fine.lean[: len(whole.lean)] = np.maximum(fine.lean[: len(whole.lean)], whole.lean)
    turns = np.linalg.norm(mesh.normals[sides[:, 0]] - mesh.normals[sides[:, 1]], axis=1)
    surface = dataclasses.replace(fine, faces=mesh.faces, shades=mesh.faces, middles=middles)
    return surface, Sides(np.ascontiguousarray(sides, np.int32), turns), cut


@entry
def mark(  # noqa: PLR0913, PLR0917
    points: Floats, normals: Floats, sides: Sides, sun: Floats, window: Window, cosines: Floats, marked: Bytes
) -> None:  # fmt: skip
    """Mark the sides that are to be cut.

    Parameters
    ----------
    points, normals : (vertices and sides, 3) m and unit.
    sun : (3,), its direction.
    cosines : (2, vertices), overwritten: those of incidence and of emission.
    marked : (vertices and sides,), of which those of sides are written.
    """
    first = len(points) - len(sides.ends)
    for k in range(first):
        x, y, z = points[k, 0], points[k, 1], points[k, 2]
        nx, ny, nz = normals[k, 0], normals[k, 1], normals[k, 2]
        dx, dy, dz = window.eye[0] - x, window.eye[1] - y, window.eye[2] - z
        cosines[0, k] = nx * sun[0] + ny * sun[1] + nz * sun[2]
        emission = (nx * dx + ny * dy + nz * dz) / np.sqrt(max(dx * dx + dy * dy + dz * dz, 1e-300))
        cosines[1, k] = emission if depth_in(window, (x, y, z)) > 0.0 else _OUT_OF_FRAME
    for j in range(len(sides.ends)):
        a, b, turn = sides.ends[j, 0], sides.ends[j, 1], sides.turns[j]
        low, high = cosines[0, a], cosines[0, b]
        here, there = cosines[1, a], cosines[1, b]
        at_terminator = min(abs(low), abs(high)) < turn
        on_outline = min(abs(here), abs(there)) < turn and max(low, high) > _DARKEST
        marked[first + j] = (at_terminator or on_outline) and max(here, there) > -turn
