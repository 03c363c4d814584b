"""Detail of bodies beyond their shape models: boulders, craters, roughness and albedo, as fine as the camera can see.

Facets are divided under a boulder or crater until their sides are a third of it, and nowhere else, so ground without
features costs nothing; where facets are large in the light frame all are cut in four. Then vertices are moved:

    boulders     the parts above ground of convex bodies with flat sides, each with its own planes; about two fifths as
                 high as wide, and of different brightness
    craters      a parabolic floor and a rim, as deep as their age leaves: depth over diameter spreads from a quarter of
                 the fresh one's to the whole, most of them old; the rims of old ones erode first; fresh craters are
                 up to a fifth brighter
    roughness    `grain`: craters or boulders of all sizes below these, at vertices and below facets; in patches, or
                 evenly where there is smooth ground

Boulders, roughness and the variation of albedo are missing on the share `smooth_share` of the surface that is low and
even (`smooth_ground`).

Left out: boulders that overhang, ponds and slides, secondary craters, and any link of boulders or albedo to slopes; the
real positions of features (the shape model has the large ones).

The numbers of boulders and craters of each size:

    boulders     N(> D) = n (D / 5 m)^-p per km2: n = 949, p = 3.1 on Itokawa, where 373 are larger than 5 m on
                 0.393 km2 (Michikami et al. 2008, Earth Planets Space 60, 13); Eros has 6760 larger than 15 m (Thomas
                 et al. 2001, Nature 413, 394) and p = 3.25 (Michikami and Hagermann 2021, Icarus 357, 114282)
    craters      N(> D) = c D^-2 per m2, the steady state (Moore et al. 1980)

Sizes are drawn octave by octave, 2^k to 2^(k+1) m, each with a generator of its own, and positions evenly by area over
the shape model. So an octave is the same for a seed whatever other octaves are made. The smallest features fade in with
`smallest_m`: their height is a share of the full one that rises from 0 at `smallest_m` to 1 at FADED times that.

Facets smaller than the camera resolves cost as much as large ones, so they are merged (`coarser`): vertices are
collected in cells of a grid, and each cell has one vertex, at the mean position of its own and with the mean of their
*fine* normals. Shading keeps the slopes that the fine model has at the scale of the cell; facets whose corners coincide
vanish. With cells of half a pixel nothing is lost that would show in a pixel's mean. Source of the method: vertex
clustering, Rossignac and Borrel 1993, Multi-resolution 3D approximations.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from operator import attrgetter
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from emulator.scene.bodies.albedo import clouded, smooth_step, with_albedo
from emulator.scene.bodies.curved_sides import split_round
from emulator.scene.bodies.grain import (
    CRATER_REACH,
    RIM,
    Octaves,
    crater_age,
    crater_height,
    crater_tile,
    fractal_noise,
    noise_tile,
    octaves,
    on_facets,
    write_heights,
)
from emulator.scene.bodies.mesh import Mesh, facet_vectors, group_means, vertex_normals
from emulator.scene.bodies.smooth_ground import smooth_ground
from emulator.scene.bodies.table import Clouds, Detail, Regolith
from emulator.scene.files import Kind, cached_arrays
from firmware_protocol.events import Floats, Int64s

if TYPE_CHECKING:
    from scipy.spatial import cKDTree


FADED = 1.5
_PER_FEATURE = 8  # numbers between 0 and 1 that shape one of them


@dataclass(frozen=True)
class Law:
    """N(> D) = number D^-power per m2, D in m; `kind` separates the random numbers of boulders and craters."""

    kind: int
    number: float
    power: float


class Features(NamedTuple):
    """Boulders or craters of a body, in its frame.

    Attributes
    ----------
    places, normals : (n, 3) m and unit, on the shape model.
    diameters_m : (n,), the largest first.
    weights : (n,), 0 to 1, how far they have faded in.
    lots : (n, 8), random numbers, uniform from 0 to 1, for their shape.
    """

    places: Floats
    normals: Floats
    diameters_m: Floats
    weights: Floats
    lots: Floats


def number_above(law: Law, diameter_m: float) -> float:
    """Return the number of features larger than `diameter_m` on a square metre."""
    return float(law.number * diameter_m**-law.power)


def features(mesh: Mesh, law: Law, seed: int, smallest_m: float, largest_m: float) -> Features:
    """Return the features of a body between two sizes."""
    first, last = math.floor(math.log2(smallest_m)), math.ceil(math.log2(max(largest_m, smallest_m)))
    octaves = [_octave(mesh, law, seed, k) for k in reversed(range(first, max(last, first + 1)))]
    places, normals, sizes, lots = (np.concatenate(parts) for parts in zip(*octaves, strict=True))
    chosen = np.flatnonzero((sizes > smallest_m) & (sizes <= largest_m))
    chosen = chosen[np.argsort(-sizes[chosen], kind="stable")]
    heights = smooth_step((sizes[chosen] / smallest_m - 1) / (FADED - 1))  # shares of their own
    return Features(places[chosen], normals[chosen], sizes[chosen], heights, lots[chosen])


def _octave(mesh: Mesh, law: Law, seed: int, k: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return positions, normals, diameters and random numbers of the features of 2^k to 2^(k + 1) m."""
    rng = np.random.default_rng([seed, law.kind, k + 1024])
    low_m, high_m = 2.0**k, 2.0 ** (k + 1)
    count = rng.poisson((number_above(law, low_m) - number_above(law, high_m)) * mesh.area_m2)
    u = rng.random(count)
    sizes = low_m * (1 - u * (1 - (low_m / high_m) ** law.power)) ** (-1 / law.power)
    places, normals = _places(mesh, rng.random((count, 3)))
    return places, normals, sizes, rng.random((count, _PER_FEATURE))


def _places(mesh: Mesh, lots: Floats) -> tuple[Floats, Floats]:
    """Return positions and normals, (n, 3) each, uniform by area; `lots` are (n, 3) random numbers from 0 to 1."""
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(facet_vectors(mesh.vertices, mesh.faces), axis=1)
    upto = np.cumsum(areas)
    facet = np.minimum(np.searchsorted(upto, lots[:, 0] * upto[-1], side="right"), len(areas) - 1)
    s, t = np.sqrt(lots[:, 1]), lots[:, 2]
    shares = np.stack([1 - s, s * (1 - t), s * t], axis=1)[:, :, None]
    normals = (shares * mesh.normals[mesh.faces[facet]]).sum(axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), mesh.normals[mesh.faces[facet, 0]])
    return (shares * corners[facet]).sum(axis=1), normals


def facet_size_m(mesh: Mesh) -> float:
    """Return the side of a square as large as the mean facet, m."""
    return float(np.sqrt(mesh.area_m2 / len(mesh.faces)))


def coarser(mesh: Mesh, cell_m: float) -> Mesh:
    """Return the mesh with one vertex a cell of `cell_m`; the mesh itself where that saves less than a tenth."""
    cells = np.floor(mesh.vertices / cell_m).astype(np.int64)
    cells -= cells.min(axis=0)
    extent = cells.max(axis=0) + 1
    key = (cells[:, 0] * extent[1] + cells[:, 1]) * extent[2] + cells[:, 2]
    _, first, cell, count = np.unique(key, return_index=True, return_inverse=True, return_counts=True)
    corners = cell[mesh.faces]
    a, b, c = corners.T
    corners = corners[(a != b) & (b != c) & (c != a)]
    turned = (corners.argmin(axis=1)[:, None] + np.arange(3)) % 3  # which corner comes first does not matter
    kept = np.unique(np.take_along_axis(corners, turned, axis=1), axis=0)
    tints = mesh.tints(lambda values: group_means(mesh.at_vertices(values)[:, None], cell, count)[kept, 0])
    if len(kept) > 0.9 * len(mesh.faces) or not len(kept):
        return mesh
    vertices, normals = group_means(mesh.vertices, cell, count), group_means(mesh.normals, cell, count)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    cancelled = length < 1e-6  # both sides of a thin sheet in one cell: any of its normals serves
    normals = np.where(cancelled, mesh.normals[first], normals) / np.where(cancelled, 1.0, np.maximum(length, 1e-6))
    return dataclasses.replace(mesh, vertices=vertices, faces=kept.astype(np.int32), normals=normals, **tints)


_BOULDER, _CRATER = range(2)
_PATCHES, _ALBEDO = 1, 2
_ACROSS = 2.0  # facets across the smallest boulder or crater
_RESOLVED = 6.0  # facets of the shape model across a feature that the model has itself; with fewer a rim is lost
_SIDES = {_BOULDER: 1.8, _CRATER: 2.6}  # of facets across a feature, at least
_FACETS_EACH = 90.0  # of one feature, with those around it
_DRAWN = 0.45  # radii on both sides of a rim from which vertices are drawn towards it
_REACH = {_BOULDER: 1.15, _CRATER: CRATER_REACH}  # of the radius
_UNLIKE = 0.12  # rms albedo of boulders
_FRESH = 0.2  # by which the youngest craters are brighter
_PLANES = 7
_CHANCE = 3  # number of the random number of a feature that decides whether it lies beside smooth ground
_GRAVITY_CELLS = 16  # cells of the body's radius, for its gravity
_FINE_ALBEDO = 0.23  # of the variation of albedo, in octaves below facets
_FINE_CLOUD, _CLOUD_GAIN = 0.3, 0.68  # the same of clouds, in the first octave, and over that of the one before
_FINEST_PX = 6.0  # of the waves of roughness, whatever the facets: finer ones are hardly seen through a lens
_GAIN = 0.5  # of the height of an octave of roughness over that of the one before
_SMOOTHED = 0.9  # of the roughness and the variation of albedo, missing on smooth ground


def weathered(mesh: Mesh, p: Regolith, pixel_m: float) -> Mesh:
    """Return the body with the detail of `p`, for a camera whose pixel spans `pixel_m` at its closest."""
    size_m = facet_size_m(mesh)
    largest_m = _RESOLVED * size_m
    smallest_m = smallest_feature_m(mesh, p, pixel_m)
    laws = _laws(p) if smallest_m < largest_m else {}
    kinds = {kind: features(mesh, law, p.seed, smallest_m, largest_m) for kind, law in laws.items()}
    smooth = smooth_ground(mesh, coarser(mesh, mesh.radius_m / _GRAVITY_CELLS), p.smooth_share)
    if _BOULDER in kinds:  # they are fewer near smooth ground, by a random number of each
        kept = kinds[_BOULDER].lots[:, _CHANCE] >= smooth(kinds[_BOULDER].places)
        kinds[_BOULDER] = Features(*(part[kept] for part in kinds[_BOULDER]))
    fine = mesh
    for _ in range(_divisions(mesh, p, pixel_m)):
        fine = split_round(fine, np.ones(fine.faces.shape, bool))
    fine = _divided(fine, kinds)
    if _CRATER in kinds:
        fine = _with_rims(fine, kinds[_CRATER])
    moved, tint = _shaped(fine, kinds, p)
    rough = 1 - _SMOOTHED * smooth(fine.vertices)
    in_patches, height_m = rough * _patches(fine.vertices, p, size_m), np.empty(len(fine.vertices))
    write_heights(fine.vertices, grain_of(mesh, p, pixel_m), height_m)
    even = dataclasses.replace(fine, vertices=fine.vertices + moved)
    vertices = _not_turned_over(even, even.vertices + (in_patches * height_m)[:, None] * fine.normals)
    normals = vertex_normals(vertices, fine.faces)
    pushed = dataclasses.replace(fine, vertices=vertices, normals=normals, rough=in_patches[fine.faces])
    mottled = fractal_noise(fine.vertices, mesh.radius_m, 1.5 * size_m, 0.85, 4 * p.seed + _ALBEDO)
    return with_albedo(pushed, np.maximum(1 + p.albedo_rms * rough * mottled, 0.1) * tint)


def _divisions(mesh: Mesh, p: Regolith, pixel_m: float) -> int:
    """Return how often all facets are cut in four: while they are large in the light frame and not too many."""
    affordable = math.log(max(p.most_facets / len(mesh.faces), 1)) / math.log(4)
    useful = math.log2(max(facet_size_m(mesh) / (p.facet_px * pixel_m), 1))
    return math.floor(min(affordable, useful))


def grain_of(mesh: Mesh, p: Regolith, pixel_m: float) -> Octaves:
    """Return the octaves of roughness that `weathered` gives a shape model, and those below its facets."""
    size_m = facet_size_m(mesh)
    finest_m = size_m / 2 ** _divisions(mesh, p, pixel_m)
    all_octaves = octaves(8 * size_m, min(_FINEST_PX * pixel_m, 2 * finest_m), _GAIN, p.seed, crater_tile())
    slope, tint = math.tan(math.radians(p.slope_deg)), _FINE_ALBEDO * p.albedo_rms
    grain, laws = on_facets(all_octaves, slope, tint, size_m, finest_m), _laws(p)
    # Craters upside down are boulders.
    boulders, craters = (np.array([number_above(laws[k], d) for d in grain.waves_m]) for k in (_BOULDER, _CRATER))
    upwards = np.where(boulders > craters, -1.0, 1.0)
    return grain._replace(heights_m=upwards * grain.heights_m, tints=upwards * grain.tints)


def cloud_grain(mesh: Mesh, p: Clouds, pixel_m: float) -> Octaves:
    """Return the octaves of clouds below the facets of a `clouded` body: albedo alone."""
    facet_m = facet_size_m(mesh)
    finest_m = min(_FINEST_PX * pixel_m, 2 * facet_m)
    grain = on_facets(octaves(4 * facet_m, finest_m, _CLOUD_GAIN, p.seed, noise_tile()), 0.0, 0.0, facet_m, facet_m)
    return grain._replace(tints=_FINE_CLOUD * _CLOUD_GAIN ** np.arange(len(grain.waves_m)) * (1 - grain.on_facets))


def _patches(places: Floats, p: Regolith, size_m: float) -> Floats:
    """Return the share of roughness, (n,) of mean square 1: in patches where the body has no smooth ground."""
    if p.smooth_share > 0:
        return np.ones(len(places))
    patches = np.clip(0.6 + 0.4 * fractal_noise(places, 60 * size_m, 10 * size_m, 0.5, 4 * p.seed + _PATCHES), 0.2, 1.0)
    return np.asarray(patches / np.sqrt((patches**2).mean()))


def smallest_feature_m(mesh: Mesh, p: Regolith, pixel_m: float) -> float:
    """Return the least diameter of boulders and craters: proportional to the pixel, within the limits of `p`."""
    low_m = max(p.smallest_m, _ACROSS * p.facet_px * pixel_m)
    high_m = largest_m = max(_RESOLVED * facet_size_m(mesh), low_m)
    allowed = max(p.most_facets - len(mesh.faces) * 4 ** _divisions(mesh, p, pixel_m), 0) / _FACETS_EACH

    def count(from_m: float) -> float:
        return sum(number_above(w, from_m) - number_above(w, largest_m) for w in _laws(p).values()) * mesh.area_m2

    if count(low_m) <= allowed:
        return low_m
    for _ in range(50):
        middle_m = math.sqrt(low_m * high_m)
        low_m, high_m = (middle_m, high_m) if count(middle_m) > allowed else (low_m, middle_m)
    return high_m


def _laws(p: Regolith) -> dict[int, Law]:
    return {
        _BOULDER: Law(_BOULDER, p.boulders_km2 * 1e-6 * 5.0**-p.boulder_power, -p.boulder_power),
        _CRATER: Law(_CRATER, p.craters, 2.0),
    }


def _divided(mesh: Mesh, kinds: dict[int, Features]) -> Mesh:
    """Return the body with facets as small under features as they need."""
    from scipy.spatial import cKDTree  # loaded where it is used: it takes longer than the rest of a short run's imports

    fine, first = mesh, 0
    for _ in range(12):
        # Facets before `first` were left whole before, and would be again.
        faces = fine.faces[first:]
        wanted_m = np.full(faces.shape, np.inf)
        ends = fine.vertices[np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)]
        sides_m = np.linalg.norm(ends[:, :, 1] - ends[:, :, 0], axis=2)
        middles = ends.mean(axis=2).reshape(-1, 3)
        tree = cKDTree(middles)
        for kind, group in kinds.items():
            feature, where = _near(tree, group, _REACH[kind], float(sides_m.max()) / 2)
            gap_m = np.linalg.norm(middles[where] - group.places[feature], axis=1) - 0.5 * sides_m.ravel()[where]
            over = gap_m < _REACH[kind] * group.diameters_m[feature] / 2
            np.minimum.at(wanted_m.reshape(-1), where[over], group.diameters_m[feature[over]] / _SIDES[kind])
        split = np.zeros(fine.faces.shape, np.bool_)
        split[first:] = sides_m > wanted_m
        if not split.any():
            break
        first = int((~split.any(axis=1)).sum())
        fine = split_round(fine, split)
    return fine


def _with_rims(mesh: Mesh, craters: Features) -> Mesh:
    """Return the mesh with the vertices near the rim of each crater moved along the ground towards the rim.

    A rim between two vertices would be cut off. The distance from the middle stays in order;
    where craters overlap a vertex belongs to the largest, and no facet turns over.
    """
    from scipy.spatial import cKDTree

    crater, where = _near(cKDTree(mesh.vertices), craters, 1 + _DRAWN, 0.0)
    _, first = np.unique(where, return_index=True)
    crater, where = crater[first], where[first]
    radius_m, normals = craters.diameters_m[crater] / 2, craters.normals[crater]
    flat = mesh.vertices[where] - craters.places[crater]
    high = (flat * normals).sum(axis=1, keepdims=True) * normals
    flat -= high
    r = np.linalg.norm(flat, axis=1) / radius_m
    beside = np.clip(np.abs(r - 1) / _DRAWN, 0, 1)
    towards = craters.weights[crater] * np.sign(1 - r) * _DRAWN * (beside - beside**3)
    vertices = mesh.vertices.copy()
    scale = (towards / np.maximum(r, 1e-6))[:, None]
    vertices[where] += scale * flat + (2 + scale) * scale * high  # the ground's height goes with the distance squared
    return dataclasses.replace(mesh, vertices=_not_turned_over(mesh, vertices))


def _not_turned_over(mesh: Mesh, moved: Floats) -> Floats:
    """Return `moved`, the vertices of facets that it would tilt by more than 60 degrees left where they were."""
    before, vertices = facet_vectors(mesh.vertices, mesh.faces), moved.copy()
    lengths = np.linalg.norm(before, axis=1)
    for _ in range(20):
        after = facet_vectors(vertices, mesh.faces)
        over = (before * after).sum(axis=1) < 0.5 * lengths * np.linalg.norm(after, axis=1)
        if not over.any():
            return vertices
        back = mesh.faces[over].ravel()
        vertices[back] = mesh.vertices[back]
    return mesh.vertices


def _near(tree: cKDTree, group: Features, reach: float, more_m: float) -> tuple[Int64s, Int64s]:
    """Return pairs of a feature and a point of the tree within `reach` of its radius, and `more_m`."""
    lists = tree.query_ball_point(group.places, reach * group.diameters_m / 2 + more_m)
    feature = np.repeat(np.arange(len(lists)), [len(points) for points in lists])
    where = np.concatenate([np.asarray(points, np.int64) for points in lists]) if len(lists) else np.empty(0, np.int64)
    return feature, where


def _shaped(mesh: Mesh, kinds: dict[int, Features], p: Regolith) -> tuple[Floats, Floats]:
    """Return the displacement of each vertex, (n, 3) m, and its albedo over that of its surroundings, (n,)."""
    from scipy.spatial import cKDTree

    moved, tint = np.zeros(mesh.vertices.shape), np.ones(len(mesh.vertices))
    tree = cKDTree(mesh.vertices)
    for kind, group in kinds.items():
        feature, where = _near(tree, group, _REACH[kind], 0.0)
        radius_m, lots = group.diameters_m[feature, None] / 2, group.lots[feature]
        x, y, z = _local((mesh.vertices[where] - group.places[feature]) / radius_m, group.normals[feature])
        shape = _crater if kind == _CRATER else _boulder
        height, bright = shape(x, y, lots, p)
        share = group.weights[feature] * (np.abs(z) < 1)
        np.add.at(moved, where, (share * height)[:, None] * radius_m * group.normals[feature])
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
    age = crater_age(lots[:, 0])
    height = crater_height(r, 2 * p.crater_depth * age, RIM * age)
    return height, _FRESH * np.clip((age - 0.7) / 0.3, 0, 1) * np.clip((1.6 - r) / 0.8, 0, 1)


def _boulder(x: Floats, y: Floats, lots: Floats, _: Regolith) -> tuple[Floats, Floats]:
    """Return the same as `_crater` for a boulder: the lowest of its planes, where they are above the ground."""
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


def detailed(mesh: Mesh, detail: Detail, pixel_m: float) -> Mesh:
    """Return the mesh with `detail`, for a camera whose pixel spans `pixel_m` on the body at its closest.

    It comes from the cache of scenes where the same sources have made it of the same mesh before: a start then takes
    one or two seconds less.
    """
    if not isinstance(detail, Regolith | Clouds):
        return mesh
    names = "vertices", "normals", "faces", "albedo", "water", "rough"
    values = cached_arrays(
        "detail",
        (mesh.made_from, detail, pixel_m),
        lambda: attrgetter(*names)(
            weathered(mesh, detail, pixel_m)
            if isinstance(detail, Regolith)
            else clouded(mesh, detail, detail.facet_px * pixel_m)
        ),
        (*2 * (Kind(np.float64, 2),), Kind(np.int32, 2), *3 * (Kind(np.float64, 2),)),
    )
    return dataclasses.replace(mesh, **dict(zip(names, values, strict=True)))
