"""Random functions of places in space, smooth and seeded: what albedo, roughness and clouds are made of.

One octave is gradient noise: at each point of a cubic lattice a direction from a hash of the point and the seed, and
between them the smooth mixture of the directions' linear functions (Perlin 2002, Improving noise). Its value depends on
the place alone, so a finer mesh of the same body has the same values at the same places.
"""

from __future__ import annotations

import math

import numba
import numpy as np
import numpy.typing as npt

from emulator.scene.bodies.compiled import entry

__all__ = ["fractal_noise"]

Floats = npt.NDArray[np.float64]

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
