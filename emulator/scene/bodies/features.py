"""Boulders and craters on a body: how many of each size, and where.

Boulders      N(> D) = n (D / 5 m)^-p per km2: n = 949, p = 3.1 on Itokawa, where 373 are larger than 5 m on 0.393 km2
              (Michikami et al. 2008, Earth Planets Space 60, 13); Eros has 6760 larger than 15 m (Thomas et al. 2001,
              Nature 413, 394) and p = 3.25 (Michikami and Hagermann 2021, Icarus 357, 114282)
Craters       N(> D) = c D^-2 per m2, the steady state (Moore et al. 1980)

Sizes are drawn octave by octave, 2^k to 2^(k+1) m, each with a generator of its own, and places evenly by area over the
shape model. So an octave is the same for a seed whatever others are made. The smallest ones fade in with `smallest_m`:
their height is a share of the full one that rises from 0 at `smallest_m` to 1 at FADED times that.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.mesh import Mesh

__all__ = ["FADED", "Features", "Law", "faded", "features", "number_above"]

Floats = npt.NDArray[np.float64]

FADED = 1.5
_PER_FEATURE = 8  # numbers between 0 and 1 that shape one of them


@dataclass(frozen=True)
class Law:
    """N(> D) = number D^-power per m2, D in m; `kind` keeps the lots of boulders and craters apart."""

    kind: int
    number: float
    power: float


@dataclass(frozen=True, eq=False)
class Features:
    """Boulders or craters of a body, in its frame.

    Attributes
    ----------
    places, normals : (n, 3) m and unit, on the shape model.
    diameters_m : (n,), the largest first.
    weights : (n,), 0 to 1, how far they have faded in.
    lots : (n, 8), even between 0 and 1, for their shape.
    """

    places: Floats
    normals: Floats
    diameters_m: Floats
    weights: Floats
    lots: Floats


def number_above(law: Law, diameter_m: float) -> float:
    """Return how many are larger on a square metre."""
    return float(law.number * diameter_m**-law.power)


def faded(diameters_m: Floats, smallest_m: float) -> Floats:
    """Return the share of their height, 0 to 1, that features have when `smallest_m` is the smallest there is."""
    x = np.clip((diameters_m / smallest_m - 1) / (FADED - 1), 0, 1)
    return np.asarray(x * x * (3 - 2 * x))


def features(mesh: Mesh, law: Law, seed: int, smallest_m: float, largest_m: float) -> Features:
    """Return those between two sizes on a body."""
    first, last = math.floor(math.log2(smallest_m)), math.ceil(math.log2(max(largest_m, smallest_m)))
    octaves = [_octave(mesh, law, seed, k) for k in reversed(range(first, last))] if law.number > 0 else []
    if not octaves:
        octaves = [(np.empty((0, 3)), np.empty((0, 3)), np.empty(0), np.empty((0, _PER_FEATURE)))]
    places, normals, sizes, lots = (np.concatenate(parts) for parts in zip(*octaves, strict=True))
    wanted = np.flatnonzero((sizes > smallest_m) & (sizes <= largest_m))
    wanted = wanted[np.argsort(-sizes[wanted], kind="stable")]
    return Features(places[wanted], normals[wanted], sizes[wanted], faded(sizes[wanted], smallest_m), lots[wanted])


def _octave(mesh: Mesh, law: Law, seed: int, k: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return places, normals, diameters and lots of those of 2^k to 2^(k + 1) m."""
    rng = np.random.default_rng([seed, law.kind, k + 1024])
    low_m, high_m = 2.0**k, 2.0 ** (k + 1)
    count = rng.poisson((number_above(law, low_m) - number_above(law, high_m)) * mesh.area_m2)
    u = rng.random(count)
    sizes = low_m * (1 - u * (1 - (low_m / high_m) ** law.power)) ** (-1 / law.power)
    places, normals = _places(mesh, rng.random((count, 3)))
    return places, normals, sizes, rng.random((count, _PER_FEATURE))


def _places(mesh: Mesh, lots: Floats) -> tuple[Floats, Floats]:
    """Return places and normals, (n, 3) each, even by area; lots (n, 3) between 0 and 1."""
    corners = mesh.vertices[mesh.faces]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    upto = np.cumsum(areas)
    facet = np.minimum(np.searchsorted(upto, lots[:, 0] * upto[-1], side="right"), len(areas) - 1)
    s, t = np.sqrt(lots[:, 1]), lots[:, 2]
    shares = np.stack([1 - s, s * (1 - t), s * t], axis=1)[:, :, None]
    normals = (shares * mesh.normals[mesh.faces[facet]]).sum(axis=1)
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    normals = np.where(length > 1e-6, normals / np.maximum(length, 1e-6), mesh.normals[mesh.faces[facet, 0]])
    return (shares * corners[facet]).sum(axis=1), normals
