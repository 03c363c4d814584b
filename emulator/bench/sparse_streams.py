"""Two reproducible event streams, in closed form or nearly so, at the limits of what a camera in space sends.

Pixels fire at each crossing of a contrast threshold, at their exact microsecond; no read-out, no refractory time.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EVENT, Events

__all__ = ["SIZE", "stars", "target"]

SIZE = (346, 260)
_THRESHOLD = 0.2  # ln units

_Floats = npt.NDArray[np.float64]
_Batch = tuple[_Floats, _Floats, _Floats, npt.NDArray[np.bool_]]
"""t in s, x, y, on, (n,) each."""


def _events(batches: list[_Batch]) -> Events:
    """Return the batches as one stream."""
    t, x, y, on = (np.concatenate(column) for column in zip(*batches, strict=True))
    events = np.zeros(len(t), EVENT)
    events["t"], events["x"], events["y"], events["on"] = t * 1e6, x, y, on
    return events[np.argsort(events["t"], kind="stable")]


def stars(duration_s: float) -> Events:
    """Return 0.34 Mev/s: 120 stars that drift at 60 px/s over a dark sky, and noise of 0.5 Hz a pixel."""
    rng = np.random.default_rng(120)
    width, height = SIZE
    noise = rng.poisson(0.5 * width * height * duration_s)
    batches = [_noise(rng, noise, duration_s)]
    for _ in range(120):
        at = rng.uniform(0, width), rng.uniform(0, height)
        batches += _star(at, 10 ** rng.uniform(-0.3, 1.15), duration_s)
    return _events(batches)


def _noise(rng: np.random.Generator, count: int, duration_s: float) -> _Batch:
    x, y = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
    return rng.uniform(0, duration_s, count), x.astype(float), y.astype(float), rng.random(count) < 0.5


def _star(at: tuple[float, float], peak: float, duration_s: float) -> list[_Batch]:
    """Return what a star fires: a Gaussian spot of sigma 1 px and of `peak` times the sky, that starts at `at`.

    Where its centre comes nearer than r to a pixel, the light there passes the level that the spot has at r.
    """
    speed_px_s, (along_x, along_y) = 60.0, (np.cos(0.3), np.sin(0.3))
    extent = int(speed_px_s * duration_s) + 6
    x, y = (values.ravel() for values in np.meshgrid(*(np.floor(c) + np.arange(-extent, extent) for c in at)))
    inside = (x >= 0) & (x < SIZE[0]) & (y >= 0) & (y < SIZE[1])
    x, y = x[inside], y[inside]
    ahead = (x - at[0]) * along_x + (y - at[1]) * along_y
    across = (y - at[1]) * along_x - (x - at[0]) * along_y
    batches: list[_Batch] = []
    for level in range(1, int(np.log1p(peak) / _THRESHOLD) + 1):
        r_squared = -2 * np.log(np.expm1(level * _THRESHOLD) / peak)
        half = np.sqrt(np.maximum(r_squared - across**2, 0))
        for sign, on in ((-1, True), (1, False)):
            t = (ahead + sign * half) / speed_px_s
            fires = (across**2 < r_squared) & (t >= 0) & (t < duration_s)
            batches.append((t[fires], x[fires], y[fires], np.full(fires.sum(), on)))
    return batches


def target(duration_s: float) -> Events:
    """Return 7.5 Mev/s: a textured disc of 200 pixels, eight waves of about 12 pixels in log light, at 127 px/s."""
    rng = np.random.default_rng(2)
    step_s = 50e-6
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    disc = np.hypot(x - SIZE[0] / 2, y - SIZE[1] / 2) < 100
    x, y = x[disc], y[disc]
    waves = [(*rng.normal(0, 2 * np.pi / 12, 2), rng.uniform(0, 2 * np.pi)) for _ in range(8)]
    offset = rng.uniform(0, 1, len(x))  # where each pixel's last event left it

    def level(t: float) -> _Floats:
        waves_now = (0.6 * np.sin(kx * (x - 122 * t) + ky * (y - 36 * t) + phase) for kx, ky, phase in waves)
        return np.asarray(sum(waves_now)) / _THRESHOLD + offset

    batches: list[_Batch] = []
    before = level(0.0)
    for k in range(round(duration_s / step_s)):
        after = level((k + 1) * step_s)
        for on in (True, False):
            fires = np.floor(after) > np.floor(before) if on else np.floor(after) < np.floor(before)
            passed = np.floor(after if on else before)[fires]
            share = (passed - before[fires]) / (after - before)[fires]
            batches.append(((k + share) * step_s, x[fires], y[fires], np.full(fires.sum(), on)))
        before = after
    return _events(batches)
