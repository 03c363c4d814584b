"""The pixel's equations in float64, written for the tests alone: no code of the product, known light at any instant.

    v' = 2 pi clip(300 Hz i, 1 Hz, 3000 Hz) (ln i - v),   i = light + 1e-4,   g = v + leak t

Runge-Kutta of fourth order in `FINE` parts of a step; an event wherever g has moved by a threshold since the last one.
"""

import dataclasses
from typing import NamedTuple

import numpy as np
from numba import njit

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import PRESETS
from tests.laboratory.accuracy.closed_scenes import PIXELS, SCENES

STEP_NS = 5_000_000
FINE = 48
DARK = 1e-4
_MOST = 4000

PARAMETERS = dataclasses.replace(
    PRESETS["davis346"], width=PIXELS, height=1, threshold_on=0.2, threshold_off=0.2, mismatch=0.03, leak_hz=0.1,
    leak_spread=0.3, refractory_us=0.0, dark_current_relative=DARK, corner_hz_at_reference=300.0, corner_min_hz=1.0,
    corner_max_hz=3000.0, source_follower_hz=0.0, parasitic_hz_at_reference=0.0, noise=NoiseParameters(),
)  # fmt: skip


class Score(NamedTuple):
    """Right sequences over active pixels, and wrong events over true events, both in percent."""

    right: float
    wrong: float


@njit(nogil=True)
def _rate(u):
    return 2 * np.pi * min(max(300 * np.exp(u), 1.0), 3000.0)


@njit(nogil=True)
def _integrate(u, h_s, pixels, signs, counts):
    """Write the signs of all events of log light u, sampled each half fine step of h_s; pixels: on, off, leak, r."""
    for j in range(u.shape[1]):
        v, r, n = u[0, j], pixels[3, j], 0
        for k in range(u.shape[0] // 2):
            u0, u1, u2 = u[2 * k, j], u[2 * k + 1, j], u[2 * k + 2, j]
            a = _rate(u0) * (u0 - v)
            b = _rate(u1) * (u1 - v - h_s / 2 * a)
            c = _rate(u1) * (u1 - v - h_s / 2 * b)
            d = _rate(u2) * (u2 - v - h_s * c)
            v += h_s / 6 * (a + 2 * b + 2 * c + d)
            g = v + pixels[2, j] * (k + 1) * h_s
            while g - r >= pixels[0, j] or g - r <= -pixels[1, j]:
                signs[j, n] = g > r
                r += pixels[0, j] if g > r else -pixels[1, j]
                n += 1
        counts[j] = n


@njit(nogil=True)
def _common(a, b):
    row = np.zeros(b.size + 1, np.int64)
    for i in range(a.size):
        corner = 0
        for j in range(b.size):
            above = row[j + 1]
            row[j + 1] = corner + 1 if a[i] == b[j] else max(above, row[j])
            corner = above
    return row[-1]


def sequences(log_light, pixels):
    """Return each pixel's polarities under log light, sampled 2 FINE times a step."""
    signs, counts = np.zeros((PIXELS, _MOST), np.bool_), np.zeros(PIXELS, np.int64)
    _integrate(log_light, STEP_NS * 1e-9 / FINE, pixels, signs, counts)
    return [row[:n] for row, n in zip(signs, counts, strict=True)]


def score(ours, true):
    """Compare two lists of sequences."""
    common = np.array([_common(a, b) for a, b in zip(ours, true, strict=True)])
    n, m = (np.array([len(s) for s in stream]) for stream in (ours, true))
    active, right = (n + m) > 0, (common == n) & (common == m)
    return Score(100 * (active & right).sum() / active.sum(), 100 * (n + m - 2 * common).sum() / m.sum())


class Cell:
    """One scene at one contrast, blur and speed: its frames, and its true sequences."""

    def __init__(self, scene, kind, contrast, blur, speed):
        self._light, steps = SCENES[scene](kind, blur, contrast, speed)
        self.steps = int(np.ceil(steps))
        self.frames = [part.astype(np.float32)[:, None, :] for part in self._light(np.arange(self.steps + 1.0))]
        self.pixels = self._drawn()
        fine = np.arange(2 * FINE * self.steps + 1) / (2 * FINE)
        self.true = sequences(np.log(self._light(fine)[0] + DARK), self.pixels)

    def _drawn(self):
        """Return thresholds, leak and first reference of the product's pixels: these are given, not under test."""
        array = PixelArray(PARAMETERS, 3)
        array.reset(LightFrame(0, self.frames[0][0]))
        fields = Field.ON, Field.OFF, Field.LEAK, Field.REFERENCE
        return np.array([array.field(which)[0] for which in fields], np.float64)

    def of_array(self, make=PixelArray, *, with_rate):
        """Score the product on this cell's frames."""
        array, light, rate = make(PARAMETERS, 3), self.frames[0], self.frames[1] * np.float32(1e9 / STEP_NS)
        array.reset(LightFrame(0, light[0], rate[0] if with_rate else None))
        found = []
        for k in range(1, self.steps + 1):
            crossings = array.step(LightFrame(k * STEP_NS, light[k], rate[k] if with_rate else None))
            found.append((crossings.pixel.copy(), crossings.on.copy()))
        pixel, on = (np.concatenate(column) for column in zip(*found, strict=True))
        return score([on[pixel == j] for j in range(PIXELS)], self.true)

    def of_rule(self, rule):
        """Score a rule: (d, a0, a1, least threshold, z) -> change of log light up to z, for whole arrays."""
        light, rate = (part[:, 0].astype(np.float64) for part in self.frames)
        u, slope = np.log(light + DARK), rate / (light + DARK)
        least, z = np.minimum(self.pixels[0], self.pixels[1]), np.arange(2 * FINE)[:, None, None] / (2 * FINE)
        rise = rule(np.diff(u, axis=0), slope[:-1], slope[1:], least, z)
        between = (u[:-1] + rise).transpose(1, 0, 2).reshape(-1, PIXELS)
        return score(sequences(np.vstack([between, u[-1:]]), self.pixels), self.true)


def straight(d, a0, a1, least, z):
    """The straight line."""
    return d * z


def cubic_or_bend(d, a0, a1, least, z):
    """The interpolation that docs/physics.md states, in float64."""
    mean, gap = (a0 + a1) / 2, np.abs(a1 - a0)
    away, steep, gentle = np.abs(d - mean), np.maximum(abs(a0), abs(a1)), np.minimum(abs(a0), abs(a1))
    opposed = a0 * a1 < 0
    unseen = (opposed & (gap / 8 > least / 2)) | (away > least / 2)
    jump = unseen & (steep < 0.3 * np.abs(d))
    turns = opposed | (a0 * d < 0) | (a1 * d < 0)
    together = np.hypot(a0, a1)
    possible = (away > gap / 6) & (away < gap / 2) & (away > 0.05 * least)
    bends = possible & (turns | (together > 3 * abs(d))) & (~opposed | (gentle <= 0.1 * steep))
    limited = ~turns & (together > 3 * np.abs(d) + 0.02)
    factor = np.where(limited, 3 * np.abs(d) / np.where(together > 0, together, 1), 1.0)
    b0, b1 = factor * a0, factor * a1
    cubic = z * (b0 + z * (3 * d - 2 * b0 - b1 + z * (b0 + b1 - 2 * d)))
    w = np.clip(3 * (0.5 - away / np.where(gap > 0, gap, 1)), 1e-4, 1)
    late = a0 * z + (a1 - a0) * w / 3 * (np.maximum(0, z - (1 - w)) / w) ** 3
    early = d - a1 * (1 - z) + (a1 - a0) * w / 3 * (np.maximum(0, w - z) / w) ** 3
    bent = np.where(np.abs(d - a0) < np.abs(d - a1), late, early)
    return np.where(jump, np.where(z >= 0.5, d, 0), np.where(bends, bent, cubic))
