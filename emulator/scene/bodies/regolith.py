"""An asteroid's ground below its shape model's facets: facets are divided under boulders and craters, and pushed.

Boulders are the parts above ground of convex bodies with flat sides, each of its own planes; about two fifths as high
as wide. Craters have a parabolic floor and a rim, as deep as their age leaves: depth over diameter spreads from a
quarter of the fresh one's to the whole, most of them old; the rims of old ones are worn off first. Fresh craters are up
to a fifth brighter, boulders of unlike brightness. Roughness moves vertices along their normals by noise.

Facets are divided under a boulder or crater until their sides are a third of it, and nowhere else: what has no features
costs nothing; where facets are large in the picture all are cut in four. Roughness is patchy. Left out: boulders that
overhang, ponds and slides, secondary craters, and any link of boulders or albedo to slopes; the real places of features
(the shape model has the large ones).
"""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.detail import facet_size_m
from emulator.scene.bodies.detail_table import Regolith
from emulator.scene.bodies.features import Features, Law, features, number_above
from emulator.scene.bodies.lit_surface import split_sides
from emulator.scene.bodies.mesh import Mesh, facet_vectors, vertex_normals
from emulator.scene.bodies.surface_noise import fractal_noise
from emulator.scene.bodies.tint import with_albedo

if TYPE_CHECKING:
    from scipy.spatial import cKDTree

__all__ = ["smallest_feature_m", "weathered"]

Floats = npt.NDArray[np.float64]
Numbers = npt.NDArray[np.int64]

_BOULDER, _CRATER = range(2)
_ROUGHNESS, _PATCHES, _ALBEDO = range(3)
_ACROSS = 2.0  # facets across the smallest boulder or crater
_RESOLVED = 3.5  # facets of the shape model across what it has itself
_SIDES = 1.8  # of facets across a feature, at least
_FACETS_EACH = 90.0  # of one feature, with those around it
_REACH = {_BOULDER: 1.15, _CRATER: 1.7}  # of the radius
_RIM = 0.25  # of the depth, its height over the ground around
_UNLIKE = 0.12  # rms albedo of boulders
_FRESH = 0.2  # by which the youngest craters are brighter
_PLANES = 7


def weathered(mesh: Mesh, p: Regolith, pixel_m: float) -> Mesh:
    """Return the body with what `p` makes on it, for a camera whose pixel spans `pixel_m` at its closest."""
    size_m = facet_size_m(mesh)
    largest_m = _RESOLVED * size_m
    smallest_m = smallest_feature_m(mesh, p, pixel_m)
    made = {
        kind: features(mesh, law, p.seed, smallest_m, largest_m)
        for kind, law in _laws(p).items()
        if smallest_m < largest_m
    }
    fine = _divided(_evenly_divided(mesh, p, pixel_m), made)
    moved, tint = _shaped(fine, made, p)
    rough_m = math.tan(math.radians(p.slope_deg)) * size_m / _steepness(mesh, p, size_m)
    noise = rough_m * _roughness(fine.vertices, p, size_m)
    vertices = fine.vertices + moved + noise[:, None] * fine.normals
    pushed = dataclasses.replace(fine, vertices=vertices, normals=vertex_normals(vertices, fine.faces))
    mottled = fractal_noise(fine.vertices, mesh.radius_m, 1.5 * size_m, 0.85, 4 * p.seed + _ALBEDO)
    return with_albedo(pushed, np.maximum(1 + p.albedo_rms * mottled, 0.1) * tint)


def _evenly_divided(mesh: Mesh, p: Regolith, pixel_m: float) -> Mesh:
    """Return the body with all facets cut in four, as often as they are large in the picture and not too many."""
    while 4 * len(mesh.faces) <= p.most_facets and facet_size_m(mesh) > 2 * p.facet_px * pixel_m:
        mesh = split_sides(mesh, np.ones(mesh.faces.shape, bool))
    return mesh


def _roughness(places: Floats, p: Regolith, size_m: float) -> Floats:
    """Return the noise of roughness, (n,): wavelengths that the shape model's facets of `size_m` can hold, and half."""
    rough = fractal_noise(places, 8 * size_m, size_m, 0.6, 4 * p.seed + _ROUGHNESS)
    patches = fractal_noise(places, 60 * size_m, 10 * size_m, 0.5, 4 * p.seed + _PATCHES)
    return rough * np.clip(0.6 + 0.4 * patches, 0.2, 1.0)


def _steepness(mesh: Mesh, p: Regolith, size_m: float) -> float:
    """Return the root mean square slope of roughness as high as the shape model's facets are wide, on these facets."""
    height = 1e-3 * size_m * _roughness(mesh.vertices, p, size_m)
    rough = mesh.vertices + height[:, None] * mesh.normals
    before, after = (facet_vectors(v, mesh.faces) for v in (mesh.vertices, rough))
    tilt = np.linalg.norm(np.cross(before, after), axis=1) / (before * after).sum(axis=1)
    return float(np.sqrt((tilt * tilt).mean())) / 1e-3


def smallest_feature_m(mesh: Mesh, p: Regolith, pixel_m: float) -> float:
    """Return the diameter from which boulders and craters are made: it goes with the pixel, within `p`'s limits."""
    low_m = max(p.smallest_m, _ACROSS * p.facet_px * pixel_m)
    high_m = largest_m = max(_RESOLVED * facet_size_m(mesh), low_m)
    most = max(p.most_facets - len(_evenly_divided(mesh, p, pixel_m).faces), 0) / _FACETS_EACH

    def count(from_m: float) -> float:
        return sum(number_above(w, from_m) - number_above(w, largest_m) for w in _laws(p).values()) * mesh.area_m2

    if count(low_m) <= most:
        return low_m
    for _ in range(50):
        middle_m = math.sqrt(low_m * high_m)
        low_m, high_m = (middle_m, high_m) if count(middle_m) > most else (low_m, middle_m)
    return high_m


def _laws(p: Regolith) -> dict[int, Law]:
    return {
        _BOULDER: Law(_BOULDER, p.boulders_km2 * 1e-6 * 5.0**-p.boulder_power, -p.boulder_power),
        _CRATER: Law(_CRATER, p.craters, 2.0),
    }


def _divided(mesh: Mesh, made: dict[int, Features]) -> Mesh:
    """Return the body with facets as small under features as they need."""
    from scipy.spatial import cKDTree  # loaded where it is used: it takes longer than the rest of a short run's imports

    fine = mesh
    for _ in range(12):
        wanted_m = np.full(fine.faces.shape, np.inf)
        ends = fine.vertices[np.sort(np.stack([fine.faces, np.roll(fine.faces, -1, axis=1)], axis=2), axis=2)]
        sides_m = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
        middles = ends.mean(axis=2).reshape(-1, 3)
        tree = cKDTree(middles)
        for kind, some in made.items():
            which, where = _near(tree, some, _REACH[kind], float(sides_m.max()) / 2)
            gap_m = np.linalg.norm(middles[where] - some.places[which], axis=1) - 0.5 * sides_m.ravel()[where]
            over = gap_m < _REACH[kind] * some.diameters_m[which] / 2
            np.minimum.at(wanted_m.reshape(-1), where[over], some.diameters_m[which[over]] / _SIDES)
        split = sides_m > wanted_m
        if not split.any():
            break
        fine = split_sides(fine, split)
    return fine


def _near(tree: cKDTree, some: Features, reach: float, more_m: float) -> tuple[Numbers, Numbers]:
    """Return pairs of a feature and a point of the tree within `reach` of its radius, and `more_m`."""
    lists = tree.query_ball_point(some.places, reach * some.diameters_m / 2 + more_m)
    which = np.repeat(np.arange(len(lists)), [len(each) for each in lists])
    where = np.concatenate([np.asarray(each, np.int64) for each in lists]) if len(lists) else np.empty(0, np.int64)
    return which, where


def _shaped(mesh: Mesh, made: dict[int, Features], p: Regolith) -> tuple[Floats, Floats]:
    """Return how far each vertex is moved, (n, 3) m, and its albedo beside that of its surroundings, (n,)."""
    from scipy.spatial import cKDTree

    moved, tint = np.zeros(mesh.vertices.shape), np.ones(len(mesh.vertices))
    tree = cKDTree(mesh.vertices)
    for kind, some in made.items():
        which, where = _near(tree, some, _REACH[kind], 0.0)
        radius_m, lots = some.diameters_m[which, None] / 2, some.lots[which]
        x, y, z = _local((mesh.vertices[where] - some.places[which]) / radius_m, some.normals[which])
        shape = _crater if kind == _CRATER else _boulder
        height, bright = shape(x, y, lots, p)
        share = some.weights[which] * (np.abs(z) < 1)
        np.add.at(moved, where, (share * height)[:, None] * radius_m * some.normals[which])
        np.multiply.at(tint, where, 1 + share * bright)
    return moved, tint


def _local(offsets: Floats, normals: Floats) -> tuple[Floats, Floats, Floats]:
    """Return coordinates along two tangents and the normal."""
    across = np.cross(normals, np.eye(3)[np.abs(normals).argmin(axis=1)])
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    third = np.cross(normals, across)
    return (offsets * across).sum(axis=1), (offsets * third).sum(axis=1), (offsets * normals).sum(axis=1)


def _crater(x: Floats, y: Floats, lots: Floats, p: Regolith) -> tuple[Floats, Floats]:
    """Return height in radii and added brightness at (x, y) radii from the middle."""
    r = np.hypot(x, y)
    age = 0.25 + 0.75 * lots[:, 0] ** 2
    depth = 2 * p.crater_depth * age
    rim = _RIM * age * depth
    apron = np.clip((_REACH[_CRATER] - r) / (_REACH[_CRATER] - 1), 0, 1)
    height = np.where(r < 1, depth * (r * r - 1) + rim * np.minimum(r, 1) ** 2, rim * apron**2)
    return height, _FRESH * np.clip((age - 0.7) / 0.3, 0, 1) * np.clip((1.6 - r) / 0.8, 0, 1)


def _boulder(x: Floats, y: Floats, lots: Floats, _: Regolith) -> tuple[Floats, Floats]:
    """Return as `_crater` does for a boulder: the lowest of its planes, where they are above the ground."""
    turn = 2 * math.pi * lots[:, 0]
    cosine, sine = np.cos(turn), np.sin(turn)
    along, across = x * cosine + y * sine, (y * cosine - x * sine) / (0.6 + 0.4 * lots[:, 7])
    height = 0.4 + 0.4 * lots[:, 1] + 0.6 * (lots[:, 2] - 0.5) * along
    for k in range(_PLANES):
        azimuth = 2 * math.pi * (k + 0.7 * (lots[:, (k + 3) % 7] - 0.5)) / _PLANES
        steep = 1.0 + 2.0 * lots[:, (k + 5) % 7]
        height = np.minimum(height, steep * (1 - along * np.cos(azimuth) - across * np.sin(azimuth)))
    bright = _UNLIKE * math.sqrt(12) * (lots[:, 6] - 0.5)
    return np.maximum(height, 0), np.where(height > 0, bright, 0.0)
