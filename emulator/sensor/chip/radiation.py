"""Particles that cross the chip: straight tracks of events, at a rate per area and time.

A particle meets the chip anywhere, at any time (a Poisson process, drawn by slots). Its direction is that of isotropic
flux through a plane: the square of the cosine to the normal is uniform, the azimuth too. While it crosses the sensitive
layer it moves sideways by depth times the tangent; each pixel under that line raises an ON event at that moment,
because charge looks like light, and some raise an OFF event when the charge has drained, after an exponential time.

The pixel's own level is left alone. Pixels that a dose turns hot are in `defects`.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.slots import SLOT_NS, Pending, SlottedEvents, Window, release, reserve
from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import kernel, kernel_that_allocates
from emulator.sensor.numerics.keyed import Purpose, root_of
from emulator.sensor.numerics.keyed_kernels import high, low, stream, unit, word
from emulator.sensor.presets import SensorParameters

__all__ = ["Particles", "hits_per_second", "path"]

_UM2_PER_CM2 = 1e8
_PIXELS = 1 << 20  # first index of the numbers that a track's pixels draw
_ONE = np.uint64(1)


class _Chip(NamedTuple):
    """The constants of a chip."""

    root: np.uint64
    mean_gap: float  # between particles, as a share of a slot
    width: int
    height: int
    depth_px: float
    off_share: float
    recovery_ns: float


class _Track(NamedTuple):
    """Path of a particle through the layer, in pixels, from its entry (share 0) to its exit (share 1)."""

    x: float
    y: float
    along_x: float
    along_y: float


def hits_per_second(p: SensorParameters) -> float:
    """Return the mean number of particles per second that cross a chip."""
    return p.radiation.hits_per_cm2_s * p.width * p.height * p.radiation.pixel_pitch_um**2 / _UM2_PER_CM2


@kernel
def _until_next(at: float, along: float) -> tuple[float, float]:
    """Return the share of a track at which it first leaves its row or column, and the share for a whole one."""
    if along == 0:
        return math.inf, math.inf
    within = at - math.floor(at)
    return (1 - within) / along if along > 0 else -within / along, abs(1 / along)


@kernel
def path(track: _Track, width: int, height: int, pixel: npt.NDArray[np.int64]) -> int:
    """Write the pixels under a track into `pixel`, (width + height + 2,) int64, in order; return how many.

    From pixel to pixel across the nearest border (Amanatides and Woo, 1987), until the track or the chip ends.
    """
    x, y = int(track.x), int(track.y)
    next_x, every_x = _until_next(track.x, track.along_x)
    next_y, every_y = _until_next(track.y, track.along_y)
    n = 0
    while 0 <= x < width and 0 <= y < height:
        pixel[n] = y * width + x
        n += 1
        if min(next_x, next_y) >= 1:
            break
        if next_x < next_y:
            x += 1 if track.along_x > 0 else -1
            next_x += every_x
        else:
            y += 1 if track.along_y > 0 else -1
            next_y += every_y
    return n


@kernel
def _track(base: np.uint64, chip: _Chip) -> _Track:
    where, direction = word(base, 1), word(base, 2)
    cosine2, azimuth = unit(high(direction)), 2 * math.pi * unit(low(direction))
    length = chip.depth_px * math.sqrt((1 - cosine2) / cosine2)
    return _Track(
        unit(high(where)) * chip.width,
        unit(low(where)) * chip.height,
        length * math.cos(azimuth),
        length * math.sin(azimuth),
    )


@kernel
def _strike(base: np.uint64, t_ns: int, pixel: npt.NDArray[np.int64], chip: _Chip, pending: Pending, n: int) -> int:
    """Add the events of a track's pixels to `pending` from n on; return the new n."""
    for k in range(pixel.size):
        bits, key = word(base, _PIXELS + k), np.uint64(pixel[k]) << _ONE
        pending.t_ns[n], pending.key[n] = t_ns, key | _ONE
        n += 1
        if unit(high(bits)) < chip.off_share:
            pending.t_ns[n] = t_ns + 1 + int(-chip.recovery_ns * math.log(unit(low(bits))))
            pending.key[n] = key
            n += 1
    return n


@kernel_that_allocates
def _draw_slot(
    slot: int, chip: _Chip, pixel: npt.NDArray[np.int64], dead: npt.NDArray[np.bool_], pending: Pending, n: int
) -> tuple[Pending, int]:
    """Add the particles of a slot to `pending` from n on."""
    slot_base, t, k = stream(chip.root, slot), 0.0, 0
    while True:
        base = stream(slot_base, k)
        t -= chip.mean_gap * math.log(unit(high(word(base, 0))))
        if t >= 1:
            return pending, n
        hit = path(_track(base, chip), chip.width, chip.height, pixel)
        alive = 0
        for j in range(hit):
            pixel[alive] = pixel[j]
            alive += not dead[pixel[j]]
        pending = reserve(pending, n, 2 * alive)
        n = _strike(base, slot * SLOT_NS + int(t * SLOT_NS), pixel[:alive], chip, pending, n)
        k += 1


@cached_entry
def _advance(
    window: Window,
    chip: _Chip,
    dead: npt.NDArray[np.bool_],
    pending: Pending,
    n: int,
) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
    """Draw the slots up to t1; return the events pending after t1, and the packed events before it, unsorted."""
    pixel = np.empty(chip.width + chip.height + 2, np.int64)
    for slot in range(window.slot, -(-window.t1_ns // SLOT_NS)):
        pending, n = _draw_slot(slot, chip, pixel, dead, pending, n)
    keys = np.empty(n + 1, np.uint64)
    found, remaining = release(window, pending, n, keys)
    return pending, remaining, keys[:found]


class Particles(SlottedEvents):
    """The events that particles raise on a chip.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor, with `radiation.hits_per_cm2_s` > 0.
    seed : int
        Keys the particles.
    dead : (n,) int64
        Pixels that raise no events.
    """

    def __init__(self, parameters: SensorParameters, seed: int, dead: npt.NDArray[np.int64]) -> None:
        p, r = parameters, parameters.radiation
        super().__init__(p.width * p.height)
        self._dead = np.zeros(p.width * p.height, np.bool_)
        self._dead[dead] = True
        self._chip = _Chip(
            root=root_of(seed, Purpose.PARTICLES),
            mean_gap=1 / (hits_per_second(p) * SLOT_NS * 1e-9),
            width=p.width,
            height=p.height,
            depth_px=r.depth_um / r.pixel_pitch_um,
            off_share=r.off_share,
            recovery_ns=r.recovery_us * 1000,
        )

    def _advance(
        self, window: Window, light: npt.NDArray[np.float32], pending: Pending, known: int
    ) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
        result: tuple[Pending, int, npt.NDArray[np.uint64]] = _advance(window, self._chip, self._dead, pending, known)
        return result
