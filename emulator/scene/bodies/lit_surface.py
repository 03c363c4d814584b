"""Points at which the light of a surface is computed: one point and normal for each radiance that a renderer receives.

On a smooth surface each vertex has one radiance. On a flat-shaded one each vertex has one for each plane that meets
there: corners of facets that lie in one plane share theirs, so subdividing a flat side costs one radiance a vertex.

Points are a little away from the vertices: on smooth surfaces above them, so that the facets around count for shadows;
on flat ones inside their plane's facets, so that at the foot of a wall each corner lies clearly on one side of it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import Numbers, cross, dot, entry, minus, row
from emulator.scene.bodies.mesh import Mesh, facet_vectors, group_means
from firmware_protocol.events import Floats, Mask

_LIFT = 1e-4  # of the mean length of sides
_INWARD = 1e-3  # of the way to the middle of the facets around
_MOST_FACETS = 1e7
_ONE_PLANE = 1e-6  # normals that differ by less are one


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface to be lit, in its body's frame.

    Attributes
    ----------
    vertices : (n, 3) m.
    faces : (m, 3) int32, vertices of each facet, counter-clockwise as seen from outside.
    shades : (m, 3) int32, for each corner the number of its radiance; `faces` where the surface is smooth.
    points, normals : (e, 3) m and unit, of each radiance.
    lean : (e,) sine of the largest angle between a normal and the facets that meet there: a point is seen only by eyes
        that are not lower than this under its tangent plane.
    smooth : True: normals are interpolated.
    albedo : (e,) of each radiance, relative to the body's law of reflection; None: 1 everywhere.
    water : (e,) share of open water; None: no water.
    rough : (e,) of the grain, see `Mesh`; None: no grain.
    between : (m, 7) int32, vertices at which facets may be cut, see `curved_sides`; None: none.
    """

    vertices: Floats
    faces: Numbers
    shades: Numbers
    points: Floats
    normals: Floats
    lean: Floats
    smooth: bool
    albedo: Floats | None = None
    water: Floats | None = None
    rough: Floats | None = None
    between: Numbers | None = None


def lit_surface(mesh: Mesh, *, smooth: bool) -> Surface:
    """Return where a mesh is to be lit."""
    if not smooth:
        return _flat(mesh)
    least = np.ones(len(mesh.vertices))
    _lower_to_facets(mesh.vertices, mesh.faces, mesh.normals, least)
    lean = np.where(least > 0, np.sqrt(np.maximum(1 - least * least, 0)), 1.0) + 1e-9
    points = mesh.vertices + _LIFT * mean_side_m(mesh.vertices, mesh.faces) * mesh.normals
    tints = mesh.tints(mesh.at_vertices)
    return Surface(mesh.vertices, mesh.faces, mesh.faces, points, mesh.normals, lean, True, **tints)


@entry
def _lower_to_facets(vertices: Floats, faces: Numbers, normals: Floats, least: Floats) -> None:
    """Lower `least`, (n,), to the cosine between a vertex's normal and that of each facet that meets there."""
    for f in range(len(faces)):
        first = row(vertices, faces[f, 0])
        plane = cross(minus(row(vertices, faces[f, 1]), first), minus(row(vertices, faces[f, 2]), first))
        length = math.sqrt(max(dot(plane, plane), 1e-300))
        for k in range(3):
            v = faces[f, k]
            least[v] = min(least[v], dot(plane, row(normals, v)) / length)


def _flat(mesh: Mesh) -> Surface:
    """Merge corners at one vertex whose normals round to the same value; rounding may split some, which is harmless."""
    planes = facet_vectors(mesh.vertices, mesh.faces)
    planes /= np.maximum(np.linalg.norm(planes, axis=1, keepdims=True), 1e-300)
    normals = np.repeat(planes, 3, axis=0)
    tints = mesh.tints(np.ravel)
    key = np.column_stack([mesh.faces.ravel(), np.round(normals / _ONE_PLANE), *tints.values()])
    _, first, shade = np.unique(key, axis=0, return_index=True, return_inverse=True)
    shade = shade.ravel()
    middles = np.repeat(mesh.vertices[mesh.faces].mean(axis=1), 3, axis=0)
    inside = group_means(middles, shade, np.bincount(shade))
    points = mesh.vertices[mesh.faces.ravel()[first]] * (1 - _INWARD) + _INWARD * inside
    shades = shade.astype(np.int32).reshape(-1, 3)
    lean = np.full(len(points), 1e-9)
    chosen = {name: values[first] for name, values in tints.items()}
    return Surface(mesh.vertices, mesh.faces, shades, points, normals[first], lean, False, **chosen)


def shadow_triangles(mesh: Mesh) -> Floats:
    """Return the triangles that cast a mesh's shadow, (m, 3, 3) m, seen from their outside; both sides of a sheet."""
    triangles = mesh.vertices[mesh.faces]
    return np.concatenate([triangles, triangles[:, ::-1]]) if mesh.open_edges else triangles


def subdivide(mesh: Mesh, size_m: float, cut: Callable[[Mesh, Mask], Mesh] | None = None) -> Mesh:
    """Return a mesh without a side longer than `size_m`, cut by `cut` or else in the middle of chords.

    No vertex is put on a side of one facet alone.
    """
    if not size_m > 0:
        raise ValueError(f"a size of {size_m} m: sides can be made no longer than a length above 0")
    if mesh.area_m2 / size_m**2 > _MOST_FACETS:
        raise ValueError(f"a size of {size_m} m: sides as short would need more than {_MOST_FACETS:g} facets")
    while True:
        low, high = (mesh.vertices[ends] for ends in _ends(mesh.faces))  # so that both facets of a side agree
        split = ((low - high) ** 2).sum(axis=2) > size_m * size_m
        if not split.any():
            return mesh
        mesh = (cut or split_sides)(mesh, split)


_CELLS = 1023  # a side of the box around a mesh


def near_in_memory(mesh: Mesh) -> Mesh:
    """Return the mesh with facets and vertices in the order of Morton's curve.

    What is drawn together is then read together: itokawa and eros took 5 to 24 % less time.
    """
    middles = mesh.vertices[mesh.faces].mean(axis=1)
    low = middles.min(axis=0)
    cells = ((middles - low) * (_CELLS / max(float(np.ptp(middles, axis=0).max()), 1e-300))).astype(np.int64)
    along = np.zeros(len(cells), np.int64)  # the bits of three whole numbers in turns
    for bit, axis in itertools.product(range(_CELLS.bit_length()), range(3)):
        along |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
    order = np.argsort(along, kind="stable")
    faces = mesh.faces[order]
    _, first = np.unique(faces, return_index=True)
    vertices = faces.ravel()[np.sort(first)]
    number = np.empty(len(mesh.vertices), np.int32)
    number[vertices] = np.arange(len(vertices))
    tints = mesh.tints(lambda values: values[order])
    places, normals = mesh.vertices[vertices], mesh.normals[vertices]
    return replace(mesh, vertices=places, faces=number[faces], normals=normals, **tints)


def _ends(faces: Numbers) -> tuple[Numbers, Numbers]:
    after = np.roll(faces, -1, axis=1)
    return np.minimum(faces, after), np.maximum(faces, after)


def middles_of(mesh: Mesh, split: Mask) -> tuple[Numbers, npt.NDArray[np.intp]]:
    """Return the sides of `split`, (m, 3), each once: their ends, (n, 2), and the number of each chosen one among them.

    The second array has an entry for each True in `split`, row after row.
    """
    low, high = _ends(mesh.faces)
    count = len(mesh.vertices)
    sides, number = np.unique(low[split].astype(np.int64) * count + high[split], return_inverse=True)
    return np.stack(np.divmod(sides, count), axis=1).astype(np.int32), number


def split_sides(mesh: Mesh, split: Mask) -> Mesh:
    """Return a mesh with a vertex in the middle of the sides of `split`, (m, 3), and the facets cut there.

    Both facets of a side must have the same value. Normals and tints of new vertices are means of its ends.
    """
    sides, number = middles_of(mesh, split)
    middle = np.full(mesh.faces.shape, -1, np.int64)
    middle[split] = len(mesh.vertices) + number
    of_ends = mesh.normals[sides]
    new_normals = of_ends.sum(axis=1)
    length = np.linalg.norm(new_normals, axis=1, keepdims=True)
    new_normals = np.where(length > 1e-6, new_normals / np.maximum(length, 1e-6), of_ends[:, 0])
    tints = mesh.tints(lambda values: cut_facets(values, (values + np.roll(values, -1, axis=1)) / 2, split))
    vertices = np.concatenate([mesh.vertices, mesh.vertices[sides].mean(axis=1)])
    normals = np.concatenate([mesh.normals, new_normals])
    faces = cut_facets(mesh.faces, middle, split).astype(np.int32)
    return replace(mesh, vertices=vertices, faces=faces, normals=normals, **tints)


def cut_facets(corners: npt.NDArray[Any], middle: npt.NDArray[Any], split: Mask) -> npt.NDArray[Any]:
    """Return the entries at the corners of facets, (n, 3), that `split_sides` makes.

    `corners` and `middle`, (m, 3), are the entries at corners and in the middle of sides from corner k to k + 1:
    numbers of vertices, or values there. Facets with fewer cut sides come first.
    """
    parts: list[npt.NDArray[Any]] = []
    for count in range(4):
        chosen = np.flatnonzero(split.sum(axis=1) == count)
        # The side that differs from the others is turned first: one side is split, or one is not.
        turn = (split if count == 1 else ~split)[chosen].argmax(axis=1)[:, None]
        columns = (turn + np.arange(3)) % 3
        a, b, c = np.take_along_axis(corners[chosen], columns, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[chosen], columns, axis=1).T
        of_facet = (
            [(a, b, c)],
            [(a, ab, c), (ab, b, c)],
            [(bc, c, ca), (a, b, bc), (a, bc, ca)],
            [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
        )[count]
        parts += [np.column_stack(part) for part in of_facet]
    return np.concatenate(parts)


@entry
def mean_side_m(vertices: Floats, faces: Numbers) -> float:
    """Return the mean length of the sides of facets."""
    total = 0.0
    for f in range(len(faces)):
        for k in range(3):
            side = minus(row(vertices, faces[f, k]), row(vertices, faces[f, k - 1]))
            total += math.sqrt(dot(side, side))
    return total / (3 * len(faces))
