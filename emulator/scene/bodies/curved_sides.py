"""Sides of smooth bodies that are cut in the middle where flat facets would be seen to be flat.

A smooth surface is curved between its vertices, and a side between two of them bends by up to an eighth of its length
times the difference of the normals. That shows in two places alone:

    where the Sun rises or sets    a chord casts another shadow than the curve, and the light is not linear
    on the outline                 the chord lies inside it

There, in each light frame anew, sides that bend by more than BEND_PX are cut, and the new vertex lies on the curve. All
other facets stay whole: that is a tenth of the facets for most of the accuracy. Shadows are those of the surface with
all sides cut.

The curve is a cubic through both vertices, along their tangent planes. Source: Vlachos et al. 2001, Curved PN
triangles.
"""

from __future__ import annotations

import dataclasses
import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import entry
from emulator.scene.bodies.lit_surface import Surface, lit_surface, middles_of, split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.sun_rays import Window, depth_in, dot, minus, row

Floats = npt.NDArray[np.float64]
Bools = npt.NDArray[np.bool_]
Bytes = npt.NDArray[np.uint8]
Numbers = npt.NDArray[np.int32]

BEND_PX = 0.05
"""Bend of a side that is not seen, pixels."""

_DARKEST = -0.1  # cosine of incidence: where no corner of a facet is above, its outline is black


class Sides(NamedTuple):
    """Sides of a surface that may be cut.

    Attributes
    ----------
    faces : (m, 3), the vertices of each facet.
    middles : (m, 3), the point in the middle of each side that may be cut; -1 for others.
    bends_m : (n,), of each point, from the middle of the chord.
    """

    faces: Numbers
    middles: Numbers
    bends_m: Floats


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

    The last vertices of the surface are these points. Its sides come in the same order, then the mesh with all of them
    cut.
    """
    everywhere = np.ones(mesh.faces.shape, np.bool_)
    sides, number = middles_of(mesh, everywhere)
    split = (np.linalg.norm(_bends(mesh, sides), axis=1) > least_m)[number].reshape(mesh.faces.shape)
    cut = split_round(mesh, split)
    sides, number = middles_of(mesh, split)
    middles = np.full(mesh.faces.shape, -1, np.int32)
    middles[split] = len(mesh.vertices) + number
    uncut, fine = lit_surface(mesh, smooth=True), lit_surface(cut, smooth=True)
    fine.lean[: len(uncut.lean)] = np.maximum(fine.lean[: len(uncut.lean)], uncut.lean)
    surface = dataclasses.replace(fine, faces=mesh.faces, shades=mesh.faces, middles=middles)
    return surface, Sides(mesh.faces, middles, np.linalg.norm(_bends(mesh, sides), axis=1)), cut


@entry
def mark(  # noqa: PLR0913, PLR0917
    points: Floats, normals: Floats, sides: Sides, sun: Floats, window: Window, at: Floats, marked: Bytes
) -> None:  # fmt: skip
    """Mark the sides that are to be cut: those of facets that the terminator or the outline may pass through.

    The cosines of incidence, or of emission, at a facet's corners then include 0, or are as near to it as they differ;
    where none of incidence is above 0, the facet is dark.

    Parameters
    ----------
    points, normals : (vertices and sides, 3) m and unit.
    sun : (3,), its direction.
    at : (3, vertices), overwritten: cosines of incidence and of emission, depths.
    marked : (vertices and sides,), of which those of sides are written.
    """
    first = len(points) - len(sides.bends_m)
    to_sun = (sun[0], sun[1], sun[2])
    eye = (window.eye[0], window.eye[1], window.eye[2])
    for k in range(first):
        point = row(points, k)
        normal = row(normals, k)
        away = minus(eye, point)
        at[0, k] = dot(normal, to_sun)
        at[1, k] = dot(normal, away) / math.sqrt(max(dot(away, away), 1e-300))
        at[2, k] = depth_in(window, point)
    marked[first:] = 0
    for f in range(len(sides.faces)):
        a = sides.faces[f, 0]
        b = sides.faces[f, 1]
        c = sides.faces[f, 2]
        depth = max(at[2, a], at[2, b], at[2, c])  # 0: out of the light frame
        lowest, highest = min(at[0, a], at[0, b], at[0, c]), max(at[0, a], at[0, b], at[0, c])
        away, towards = min(at[1, a], at[1, b], at[1, c]), max(at[1, a], at[1, b], at[1, c])
        if depth == 0.0 or towards < away - towards:
            continue
        at_terminator = lowest < highest - lowest and highest > 0.0
        on_outline = away < towards - away and highest > _DARKEST
        if at_terminator or on_outline:
            for k in range(3):
                middle = sides.middles[f, k]
                if middle >= 0 and sides.bends_m[middle - first] * window.focal_px > BEND_PX * depth:
                    marked[middle] = 1
