"""Sides of smooth bodies that are cut in thirds where flat facets would be seen to be flat.

A smooth surface is curved between its vertices, and a side between two of them bends by up to an eighth of its length
times the difference of the normals. That shows in three places alone:

    where the Sun rises or sets    a chord casts another shadow than the curve, and the light is not linear
    at a shadow's edge             under a low Sun it moves by many times the height of the curve over the chord
    on the outline                 the chord lies inside it

There, in each light frame anew, sides that bend by more than is seen are cut, and the new vertices lie on the surface,
so that a ninth of the bend is left. All other facets stay whole, three quarters of itokawa's at 1280 x 720.
Shadows are those of the surface with all sides cut.

The surface over a facet is a cubic through its vertices, along their tangent planes. Its points are computed from the
whole facet: halves of halves, each along its own normals, lie on another surface, and a low Sun shows that. Source:
Vlachos et al. 2001, Curved PN triangles.
"""

from __future__ import annotations

import dataclasses
import math
from operator import attrgetter
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.raster.topology import PARTS
from emulator.scene.bodies.compiled import ZERO, Numbers, cross, dot, entry, minus, plus, row
from emulator.scene.bodies.lit_surface import Surface, lit_surface, middles_of, near_in_memory, split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.sun_rays import Window, depth_in
from emulator.scene.files import Kind, cached_arrays
from firmware_protocol.events import Bytes, Floats, Mask

BEND_PX = 0.02  # of a side that is not seen at a shadow's edge; what casts shadows is cut from there on
_TERMINATOR_PX, _OUTLINE_PX = 0.04, 0.06  # of one that is not seen there
_UNEVEN = 0.5  # of the range of a facet's cosines: so near to 0, the terminator may pass through it
_DARKEST = -0.1  # cosine of incidence: where no corner of a facet is above, its outline is black


class Sides(NamedTuple):
    """Sides of a surface that may be cut.

    Attributes
    ----------
    faces : (m, 3), the vertices of each facet.
    between : (m, 7), points 3 to 9 of each facet, see `raster.topology`; -1 where a side may not be cut.
    bends_m : (n,), of the side of each point, from the middle of the chord; 0 for those within facets.
    """

    faces: Numbers
    between: Numbers
    bends_m: Floats


def split_round(mesh: Mesh, split: Mask) -> Mesh:
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


def with_thirds(mesh: Mesh, least_m: float) -> tuple[Surface, Sides, Mesh]:
    """Return a smooth surface with points that cut the sides that bend by more than `least_m` in thirds.

    The last vertices of the surface are these points. Its sides come in the same order, then the mesh with all of them
    cut.
    """
    sides, number = middles_of(mesh, np.ones(mesh.faces.shape, np.bool_))
    bends_m = np.linalg.norm(_bends(mesh, sides), axis=1)
    kept = bends_m > least_m
    split = kept[number].reshape(mesh.faces.shape)
    number, bends_m = (np.cumsum(kept) - 1)[number[split.ravel()]], bends_m[kept]
    # Two points a side, from its end with the lower number; then one within each facet whose sides are all cut.
    falls = (mesh.faces > np.roll(mesh.faces, -1, axis=1))[split]
    first = len(mesh.vertices)
    on_sides = np.full((*split.shape, 2), -1, np.int32)
    on_sides[split] = first + 2 * number[:, None] + (falls[:, None] != [False, True])
    inside = np.flatnonzero(split.all(axis=1))
    within = np.full(len(split), -1, np.int32)
    within[inside] = first + 2 * len(bends_m) + np.arange(len(inside))
    between = np.column_stack([on_sides.reshape(-1, 6), within])
    cut = _with_points(mesh, between, split)
    uncut, fine = lit_surface(mesh, smooth=True), lit_surface(cut, smooth=True)
    fine.lean[:first] = np.maximum(fine.lean[:first], uncut.lean)
    tints: dict[str, Any] = {}
    for name in mesh.tints(np.ravel):
        of_corners = getattr(uncut, name)
        tints[name] = np.append(of_corners, np.empty(len(cut.vertices) - first))
        tints[name][between[between >= 0]] = (of_corners[mesh.faces] @ _SHARES.T)[between >= 0]
    surface = dataclasses.replace(fine, faces=mesh.faces, shades=mesh.faces, between=between, **tints)
    return surface, Sides(mesh.faces, between, np.append(np.repeat(bends_m, 2), np.zeros(len(inside)))), cut


def cached_thirds(mesh: Mesh, least_m: float) -> tuple[Surface, Sides, Mesh]:
    """Return `with_thirds` of a closed mesh, `near_in_memory`: of a large one from the cache of scenes."""
    if len(mesh.faces) < _CACHED_FACETS:
        return with_thirds(near_in_memory(mesh), least_m)

    def made() -> tuple[npt.NDArray[Any], ...]:
        surface, sides, cut = with_thirds(near_in_memory(mesh), least_m)
        return *attrgetter(*_OF_POINTS)(surface), sides.bends_m, sides.faces, sides.between, cut.faces

    kinds = [Kind(np.float64, 2)] * 3 + [Kind(np.float64, 1)] * 5 + [Kind(np.int32, 2)] * 3
    *values, bends_m, faces, between, cut_faces = cached_arrays("thirds", (mesh.made_from, least_m), made, kinds)
    of_points = dict(zip(_OF_POINTS, values, strict=True))
    surface = Surface(faces=faces, shades=faces, smooth=True, between=between, **of_points)
    bends_m = np.empty(0) if bends_m is None else bends_m  # no side bends
    return surface, Sides(faces, between, bends_m), Mesh(surface.vertices, cut_faces, surface.normals)


_CACHED_FACETS = 1 << 15  # of fewer they are made in less than 100 ms
_OF_POINTS = "vertices", "normals", "points", "lean", "albedo", "water", "rough"  # of a `Surface`
_SHARES = np.array([(2, 1, 0), (1, 2, 0), (0, 2, 1), (0, 1, 2), (1, 0, 2), (2, 0, 1), (1, 1, 1)]) / 3
"""Shares of a facet's corners in points 3 to 9."""


def _with_points(mesh: Mesh, between: Numbers, split: Mask) -> Mesh:
    """Return the mesh, without tints, cut at the points `between`, (m, 7), on the sides `split`, (m, 3), and within."""
    points, cuts = np.column_stack([mesh.faces, between]), split @ np.array([1, 2, 4])
    vertices, upright = (
        np.concatenate([old, np.empty((points.max() + 1 - len(old), 3))]) for old in (mesh.vertices, mesh.normals)
    )
    _write_points(mesh.faces, between, _SHARES, vertices, upright)
    faces = np.concatenate([points[cuts == cut][:, parts].reshape(-1, 3) for cut, parts in PARTS.items()])
    return Mesh(vertices, faces, upright, open_edges=mesh.open_edges)


@entry
def _write_points(faces: Numbers, between: Numbers, shares: Floats, vertices: Floats, normals: Floats) -> None:
    """Write the vertices `between`, (m, 7), of facets, and their normals: points of a cubic over each facet."""
    for f in range(len(faces)):
        for point in range(7):
            if between[f, point] < 0:
                continue
            place, normal = ZERO, ZERO
            inside = 6.0 * shares[point, 0] * shares[point, 1] * shares[point, 2]
            # Weights of the corners, and of a control point on the way from each corner to each other one, in the
            # tangent plane there. The one within is the mean of these six and half of what they are above the corners.
            for i in range(3):
                corner, upright = row(vertices, faces[f, i]), row(normals, faces[f, i])
                share = shares[point, i]
                normal = plus(normal, share, upright)
                place = plus(place, share**3 - inside / 6.0, corner)
                for j in (i - 2, i - 1):
                    along = minus(row(vertices, faces[f, j]), corner)
                    control = plus(corner, 1.0 / 3.0, plus(along, -dot(along, upright), upright))
                    place = plus(place, 3.0 * share * share * shares[point, j] + inside / 4.0, control)
            length = math.sqrt(max(dot(normal, normal), 1e-300))
            for j in range(3):
                vertices[between[f, point], j] = place[j]
                normals[between[f, point], j] = normal[j] / length


@entry
def mark(  # noqa: PLR0913, PLR0917
    points: Floats, normals: Floats, sides: Sides, sun: Floats, window: Window,
    is_hidden: npt.NDArray[np.int8], at: Floats, marked: Bytes,
) -> None:  # fmt: skip
    """Mark the sides that are to be cut: those of facets that a shadow's edge, terminator or outline may pass through.

    The cosines of incidence at a facet's corners and of its plane then include 0, or are nearer to it than half of what
    they differ; where none is above 0, the facet is dark. Those of emission at its corners include 0; where none is
    above 0, the facet is not seen. Corners with and without the Sun have an edge between them.

    Parameters
    ----------
    points, normals : (vertices, then the points of sides, 3) m and unit.
    sun : (3,), its direction.
    is_hidden : (vertices and sides,), of `ShadowEdges`.
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
        away, towards = min(at[1, a], at[1, b], at[1, c]), max(at[1, a], at[1, b], at[1, c])
        if depth == 0.0 or towards < 0.0:
            continue
        plane = cross(minus(row(points, b), row(points, a)), minus(row(points, c), row(points, a)))
        of_plane = dot(plane, to_sun) / math.sqrt(max(dot(plane, plane), 1e-300))
        lowest = min(at[0, a], at[0, b], at[0, c], of_plane)
        highest = max(at[0, a], at[0, b], at[0, c], of_plane)
        at_terminator = lowest < _UNEVEN * (highest - lowest) and highest > 0.0
        on_outline = away < 0.0 and highest > _DARKEST
        lit, dark = min(is_hidden[a], is_hidden[b], is_hidden[c]), max(is_hidden[a], is_hidden[b], is_hidden[c])
        at_shadow = lit == 0 and dark == 1
        if at_shadow or at_terminator or on_outline:
            seen_px = BEND_PX if at_shadow else _TERMINATOR_PX if at_terminator else _OUTLINE_PX
            seen_m = seen_px * depth / window.focal_px
            for k in range(3):
                point = sides.between[f, 2 * k]
                if point >= 0 and sides.bends_m[point - first] > seen_m:
                    marked[point] = marked[sides.between[f, 2 * k + 1]] = 1
    for f in range(len(sides.faces)):
        within = sides.between[f, 6]
        if within >= 0 and marked[sides.between[f, 0]] and marked[sides.between[f, 2]] and marked[sides.between[f, 4]]:
            marked[within] = 1
