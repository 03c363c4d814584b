"""A planet like the Earth from space: a round body with oceans, land and clouds, as albedo at its vertices.

    ocean 0.05, land 0.12 to 0.28, ice 0.6 beyond 68 degrees, thick cloud 0.7      (Henderson-Sellers and Wilson 1983)

29 % is land. Clouds stand in belts: much at the equator and beyond 45 degrees, little at 25 degrees. The area's mean is
brought to 1, so the body's reflectance says what the whole throws back: 0.3 for the Earth. Left out: the glint of the
Sun on water, the haze above the limb, colours, and any real geography.
"""

from __future__ import annotations

import dataclasses

import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.detail_table import Clouds
from emulator.scene.bodies.lit_surface import split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.surface_noise import fractal_noise
from emulator.scene.bodies.tint import with_albedo

__all__ = ["clouded"]

Floats = npt.NDArray[np.float64]

_LAND = 0.29
_OCEAN, _ICE, _CLOUD = 0.05, 0.6, 0.7
_ICE_SINE = 0.93
_MOST_FACETS = 100_000


def clouded(mesh: Mesh, p: Clouds, facet_m: float) -> Mesh:
    """Return a round body with facets of about `facet_m` and the albedo of a clouded planet."""
    radius_m = float(np.linalg.norm(mesh.vertices, axis=1).mean())
    round_ = _round(mesh, radius_m)
    while _side_m(round_) > 1.5 * facet_m and 4 * len(round_.faces) <= _MOST_FACETS:
        round_ = _round(split_sides(round_, np.ones(round_.faces.shape, bool)), radius_m)
    return with_albedo(round_, _albedo(round_.vertices / radius_m, p))


def _round(mesh: Mesh, radius_m: float) -> Mesh:
    normals = mesh.vertices / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    return dataclasses.replace(mesh, vertices=radius_m * normals, normals=normals)


def _side_m(mesh: Mesh) -> float:
    return float(np.sqrt(mesh.area_m2 / len(mesh.faces) * 4 / np.sqrt(3)))


def _albedo(places: Floats, p: Clouds) -> Floats:
    """Return the albedo at places on the unit sphere, not yet brought to any mean."""
    height = fractal_noise(places, 1.6, 0.04, 0.6, 3 * p.seed)
    dryness = 0.5 + 0.25 * fractal_noise(places, 0.8, 0.1, 0.5, 3 * p.seed + 1)
    land = _step((height - np.quantile(height, 1 - _LAND)) / 0.1)
    ground = _OCEAN + land * (0.07 + 0.16 * np.clip(dryness, 0, 1))
    ice = _step((np.abs(places[:, 2]) + 0.02 * height - _ICE_SINE) / 0.03)
    ground = ground + ice * (_ICE - ground)
    return ground + _cover(places, p) * (_CLOUD - ground)


def _cover(places: Floats, p: Clouds) -> Floats:
    """Return the share of thick cloud, 0 to 1: streaks that run east and west, swirled by a slower noise."""
    swirl = np.stack([fractal_noise(places, 0.9, 0.2, 0.5, 3 * p.seed + 5 + k) for k in range(3)], axis=1)
    stretched = (places + 0.12 * swirl) * (1.0, 1.0, 1.7)
    density = fractal_noise(stretched, 0.7, 0.015, 0.68, 3 * p.seed + 2)
    latitude = np.arcsin(np.clip(places[:, 2], -1, 1))
    belts = 0.7 * np.cos(4.5 * latitude) - 0.9 * np.exp(-(((np.abs(latitude) - 0.45) / 0.2) ** 2))
    density = density + 0.5 * belts + 0.6 * np.sin(latitude) ** 4
    return _step((density - np.quantile(density, 1 - p.cloud_cover)) / 1.4)


def _step(x: Floats) -> Floats:
    """Return 0 below 0, 1 above 1, smooth between."""
    x = np.clip(x, 0, 1)
    return np.asarray(x * x * (3 - 2 * x))
