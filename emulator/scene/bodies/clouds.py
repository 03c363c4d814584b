"""Albedo of a planet like the Earth from space: oceans, land and clouds at the vertices of a round body.

    ocean 0.05, land 0.12 to 0.28, ice 0.6 beyond 68 degrees, thick cloud 0.7      (Henderson-Sellers and Wilson 1983)

29 % is land. Clouds lie in belts: much at the equator and beyond 45 degrees, little at 25 degrees. Albedo is relative:
`with_albedo` scales it to a mean of 1 over the surface, so the body's reflectance is that of the whole body, 0.3 for
the Earth. Left out: the glint of the Sun on water, the haze above the limb, colours, and any real geography.

The patterns come from noise, a smooth and seeded random function of the position in space; roughness uses it too. One
octave is gradient noise: at each point of a cubic lattice a direction from a hash of the point and the seed, and
between the points a smooth blend of the directions' linear functions (Perlin 2002, Improving noise). Its value depends
on the position alone, so a finer mesh of the same body has the same values at the same positions.
"""

from __future__ import annotations

import dataclasses
import math

import numba
import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import entry
from emulator.scene.bodies.lit_surface import split_sides
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.table import Clouds

Floats = npt.NDArray[np.float64]


def with_albedo(mesh: Mesh, albedo: Floats) -> Mesh:
    """Return a mesh with the albedo of its vertices, (n,) of any scale: its mean over the area becomes 1."""
    tinted = dataclasses.replace(mesh, albedo=np.ascontiguousarray(albedo[mesh.faces]))
    return dataclasses.replace(mesh, albedo=albedo[mesh.faces] / mean_albedo(tinted))


def mean_albedo(mesh: Mesh) -> float:
    """Return the mean over the area; albedo is linear over facets."""
    if mesh.albedo is None:
        return 1.0
    a, b, c = (mesh.vertices[mesh.faces[:, k]] for k in range(3))
    areas = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    return float((areas * mesh.albedo.mean(axis=1)).sum() / areas.sum())


_RMS = 0.191  # of one octave of unit amplitude, measured over 2 10^6 places


@numba.njit(error_model="numpy")
def _hash(x: int, y: int, z: int, seed: int) -> np.uint64:
    h = np.uint64(seed) ^ np.uint64(x) * np.uint64(0x9E3779B97F4A7C15)
    h = (h ^ (h >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    h = h ^ np.uint64(y) * np.uint64(0xC2B2AE3D27D4EB4F)
    h = (h ^ (h >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    h = h ^ np.uint64(z) * np.uint64(0x165667B19E3779F9)
    h = (h ^ (h >> np.uint64(31))) * np.uint64(0xBF58476D1CE4E5B9)
    return h ^ (h >> np.uint64(29))


@numba.njit(error_model="numpy")
def _slope(h: np.uint64, dx: float, dy: float, dz: float) -> float:
    """Return the linear function of a lattice point by its hash: its direction is even over the sphere."""
    up = float(h & np.uint64(0xFFFFF)) / 524288.0 - 1.0
    turn = float((h >> np.uint64(24)) & np.uint64(0xFFFFF)) * (2.0 * math.pi / 1048576.0)
    flat = math.sqrt(max(1.0 - up * up, 0.0))
    return flat * math.cos(turn) * dx + flat * math.sin(turn) * dy + up * dz


@entry
def _add(points: Floats, per_m: float, seed: int, amplitude: float, out: Floats) -> None:
    for k in range(len(points)):
        px, py, pz = points[k, 0] * per_m, points[k, 1] * per_m, points[k, 2] * per_m
        x, y, z = math.floor(px), math.floor(py), math.floor(pz)
        fx, fy, fz = px - x, py - y, pz - z
        ux = fx * fx * fx * (fx * (fx * 6.0 - 15.0) + 10.0)
        uy = fy * fy * fy * (fy * (fy * 6.0 - 15.0) + 10.0)
        uz = fz * fz * fz * (fz * (fz * 6.0 - 15.0) + 10.0)
        value = 0.0
        for corner in range(8):
            i, j, m = corner & 1, (corner >> 1) & 1, corner >> 2
            weight = (ux if i else 1.0 - ux) * (uy if j else 1.0 - uy) * (uz if m else 1.0 - uz)
            value += weight * _slope(_hash(x + i, y + j, z + m, seed), fx - i, fy - j, fz - m)
        out[k] += amplitude * value


def fractal_noise(points: Floats, longest_m: float, shortest_m: float, gain: float, seed: int) -> Floats:
    """Return noise at places, (n,), its root mean square about 1 where all octaves are there.

    Parameters
    ----------
    points : (n, 3) m.
    longest_m, shortest_m : wavelengths; each octave has half the one before, and the last ones fade in as
        `shortest_m` shrinks.
    gain : amplitude of an octave over that of the one before.
    """
    out, power, amplitude, wave_m, number = np.zeros(len(points)), 0.0, 1.0, longest_m, 0
    while wave_m > shortest_m and number < 24:
        weight = min(wave_m / shortest_m - 1.0, 1.0)
        _add(points, 1.0 / wave_m, (seed * 64 + number) & 0x7FFFFFFFFFFFFFFF, amplitude * weight, out)
        power += amplitude * amplitude
        amplitude, wave_m, number = amplitude * gain, wave_m / 2, number + 1
    return out / (_RMS * math.sqrt(power)) if number else out


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
