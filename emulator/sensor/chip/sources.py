"""Sources of random events beside the pixels: background activity, and particles that cross the chip.

Events are drawn by slots of stream time and released step by step. The draws of a slot of 1024 us depend on the slot
and the seed alone. An event may lie after its slot (a follower, the OFF event after a particle), so drawn events stay
pending until a step reaches them. The pixel's own level does not change.

Background activity, as counted in a recording, has a constant rate, some events with followers, some pixels hot. Each
pixel has a rate of its own, drawn once: log-normal around the mean, or that of a hot pixel. Primaries are drawn with
their pixel in proportion to its rate; a primary is followed by an event of the other polarity with a probability of its
pixel and polarity, after an exponential time, and each follower by another one with one probability for all. Primaries
before the start are drawn too, as far back as their followers matter. Events do not depend on the light.

Particles give straight tracks of events, at a rate per area and time. A particle meets the chip anywhere, at any time
(a Poisson process). Its direction is that of isotropic flux through a plane: the square of the cosine to the normal is
uniform, the azimuth too. While it crosses the sensitive layer it moves sideways by depth times the tangent; each pixel
under that line raises an ON event at that moment, because charge acts like light, and some raise an OFF event when the
charge has drained, after an exponential time. Pixels that a dose turns hot are in `defects`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.numerics.compiled import cached_entry, kernel, kernel_that_allocates
from emulator.sensor.numerics.keyed import Purpose, high, low, normal, root_of, stream, uniform, unit, word
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined, unpacked
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Floats, Int64s, Mask

SLOT_NS = 1_024_000
"""Length of a slot, in which events are drawn."""

LONGEST_NS = 1 << 33
"""Longest interval whose events are sorted together: time and pixel share 64 bits."""


class Pending(NamedTuple):
    """Events that are drawn and not yet released: times, and pixel << 1 | on; with free space behind them."""

    t_ns: Int64s
    key: npt.NDArray[np.uint64]


class Window(NamedTuple):
    """The first slot to draw, the start and end of the wanted interval, and the bits of a pixel's number."""

    slot: int
    t0_ns: int
    t1_ns: int
    pixel_bits: int


_Advanced = tuple[Pending, int, npt.NDArray[np.uint64]]
"""Events that stay pending, their number, and the packed events of the window."""


def new_pending() -> Pending:
    """Return an empty list of pending events."""
    return Pending(np.empty(256, np.int64), np.empty(256, np.uint64))


@kernel_that_allocates
def reserve(pending: Pending, n: int, added: int) -> Pending:
    """Return `pending`, a longer copy where there is no space for `added` events behind its first n."""
    if n + added <= pending.t_ns.size:
        return pending
    t_ns, key = np.empty(2 * (n + added), np.int64), np.empty(2 * (n + added), np.uint64)
    t_ns[:n], key[:n] = pending.t_ns[:n], pending.key[:n]
    return Pending(t_ns, key)


@kernel
def release(window: Window, pending: Pending, n: int, keys: npt.NDArray[np.uint64]) -> tuple[int, int]:
    """Pack the events of the window into `keys`, (n + 1,), and compact those after it; return both numbers."""
    shift = np.uint64(window.pixel_bits + 1)
    released = remaining = 0
    for k in range(n):
        t_ns, key = pending.t_ns[k], pending.key[k]
        pending.t_ns[remaining], pending.key[remaining] = t_ns, key
        remaining += t_ns >= window.t1_ns
        keys[released] = np.uint64(t_ns - window.t0_ns) << shift | key
        released += (t_ns < window.t1_ns) & (t_ns >= window.t0_ns)
    return released, remaining


class SlottedEvents(ABC):
    """A source of random events for an array of `pixels` pixels. `reset` comes first."""

    def __init__(self, pixels: int) -> None:
        self._pixel_bits = max(1, (pixels - 1).bit_length())

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`; events that began before are left out."""
        self._pending, self._waiting = new_pending(), 0
        self._slot, self._t_ns = t_ns // SLOT_NS, t_ns

    def step(self, t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`."""
        parts = []
        while self._t_ns < t_ns:
            parts.append(self._events_until(min(t_ns, self._t_ns + LONGEST_NS)))
        return joined(parts) if parts else NO_CROSSINGS

    def _events_until(self, t_ns: int) -> Crossings:
        window = Window(self._slot, self._t_ns, t_ns, self._pixel_bits)
        pending, self._waiting, keys = self._advance(window, self._pending, self._waiting)
        self._pending = Pending(*pending)
        self._slot = -(-t_ns // SLOT_NS)
        self._t_ns = t_ns
        return unpacked(keys, window.t0_ns, self._pixel_bits)

    @abstractmethod
    def _advance(self, window: Window, pending: Pending, n: int) -> _Advanced:
        """Draw the slots that begin before the window's end; return the pending and the packed events."""


_ONE = np.uint64(1)
_FOLLOWERS = np.uint64(1 << 32)  # of a primary: first index of the numbers that they draw
_MOST_FOLLOWERS = 1024
_BEFORE_WAITS = 16.0  # time before the start, in mean lengths of a chain of followers: e^-16 of the chains are longer


class _Constants(NamedTuple):
    """Stream, mean gap between primaries as a share of a slot, share of OFF, of repeated followers, ON over OFF."""

    root: np.uint64
    mean_gap: float
    off_share: float
    again_share: float
    on_pair_factor: float
    on_wait_factor: float


class _Rates(NamedTuple):
    """Of each pixel, (pixels,): sums of the rates of primaries up to it, share of pairs, and mean wait in ns.

    `first`, (2^n + 1,): the pixels at equal shares of the whole rate, so that few lie between two of them.
    """

    below: Floats
    pair: Floats
    wait_ns: Floats
    first: Int64s


def primaries_hz(p: SensorParameters, seed: int) -> tuple[Floats, Floats, Floats]:
    """Return each pixel's rate of primaries, Hz, the probability that an OFF one has a follower, and its mean wait, s.

    Rates hold over a long time. A probability above 1, of ON primaries, counts as 1.
    """
    b, pixel = p.background, np.arange(p.width * p.height)
    hz = b.hz * np.exp(b.spread * normal(seed, Purpose.BACKGROUND_RATE, pixel) - b.spread**2 / 2)
    hot = uniform(seed, Purpose.BACKGROUND_HOT, pixel) < b.hot_share
    hot_hz = b.hot_hz * np.exp(b.hot_spread * normal(seed, Purpose.BACKGROUND_HOT, pixel, 1) - b.hot_spread**2 / 2)
    hz = np.where(hot, hot_hz, hz)
    pair = np.where(hot, b.hot_pair_share, b.pair_share)
    followed = b.off_share * pair + (1 - b.off_share) * np.minimum(b.on_pair_factor * pair, 1)
    wait_s = 1 / (1e6 / b.pair_us + np.where(hot, hz, 0))
    return hz / (1 + followed / (1 - b.again_share)), pair, wait_s


@kernel_that_allocates
def _draw_background(
    slot: int, from_ns: int, c: _Constants, rates: _Rates, pending: Pending, n: int
) -> tuple[Pending, int]:
    """Add the events from `from_ns` on of the chains that begin in a slot to `pending` from n on."""
    base = stream(c.root, slot)
    below = rates.below
    t, k = 0.0, 0
    while True:
        gap, choice = word(base, 2 * k), word(base, 2 * k + 1)
        t -= c.mean_gap * math.log(unit(high(gap)))
        if t >= 1:
            return pending, n
        share = unit(high(choice))
        at = np.int64(share * (rates.first.size - 1))
        from_, to = rates.first[at], rates.first[at + 1]
        pixel = from_ + np.searchsorted(below[from_:to], share * below[-1], side="right")
        on = unit(low(gap)) >= c.off_share
        key, t_ns = np.uint64(pixel) << _ONE | np.uint64(on), slot * SLOT_NS + int(t * SLOT_NS)
        pending, n = _add(pending, n, from_ns, t_ns, key)
        follows = unit(low(choice)) < rates.pair[pixel] * (c.on_pair_factor if on else 1.0)
        follower, chances = 0, stream(base, _FOLLOWERS + np.uint64(k))
        while follows and follower < _MOST_FOLLOWERS:
            bits = word(chances, follower)
            wait_ns = rates.wait_ns[pixel] * (c.on_wait_factor if key & _ONE else 1.0)
            t_ns, key = t_ns + 1 + int(-wait_ns * math.log(unit(high(bits)))), key ^ _ONE
            pending, n = _add(pending, n, from_ns, t_ns, key)
            follower, follows = follower + 1, unit(low(bits)) < c.again_share
        k += 1


@kernel_that_allocates
def _add(pending: Pending, n: int, from_ns: int, t_ns: int, key: np.uint64) -> tuple[Pending, int]:
    """Add an event behind the first n, unless it is before `from_ns`: most of those drawn at a reset are."""
    if t_ns < from_ns:
        return pending, n
    pending = reserve(pending, n, 1)
    pending.t_ns[n], pending.key[n] = t_ns, key
    return pending, n + 1


@cached_entry
def _advance(
    window: Window, c: _Constants, rates: _Rates, pending: Pending, n: int
) -> tuple[tuple[Any, ...], int, npt.NDArray[np.uint64]]:
    """Draw the slots up to t1; return the events pending after t1, and the packed events before it, unsorted."""
    for slot in range(window.slot, -(-window.t1_ns // SLOT_NS)):
        pending, n = _draw_background(slot, window.t0_ns, c, rates, pending, n)
    keys = np.empty(n + 1, np.uint64)
    released, remaining = release(window, pending, n, keys)
    return pending[0:], remaining, keys[:released]


class BackgroundEvents(SlottedEvents):
    """The background activity of a chip.

    Parameters
    ----------
    parameters : the sensor, with a `background` rate.
    seed : keys all random numbers.
    dead : pixels that raise no events, (n,) int64.
    """

    def __init__(self, parameters: SensorParameters, seed: int, dead: Int64s) -> None:
        p, b = parameters, parameters.background
        hz, pair, wait_s = primaries_hz(p, seed)
        hz[dead] = 0
        below, places = np.cumsum(hz), 1 << (hz.size >> 4).bit_length()
        first = np.searchsorted(below, np.arange(places + 1) / places * below[-1], side="right")
        self._rates = _Rates(below, pair, wait_s * 1e9, first)
        root, gap = root_of(seed, Purpose.BACKGROUND), 1 / (max(float(below[-1]), 1e-12) * SLOT_NS * 1e-9)
        self._constants = _Constants(root, gap, b.off_share, b.again_share, b.on_pair_factor, b.on_wait_factor)
        chain_us = b.pair_us * max(1.0, b.on_wait_factor) / (1 - b.again_share)  # at most exponential, with this mean
        self._before_ns = round(_BEFORE_WAITS * chain_us * 1000) if b.pair_share or b.hot_pair_share else 0
        super().__init__(p.width * p.height)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`, with the events to come that follow events before."""
        super().reset(t_ns)
        self._slot = (t_ns - self._before_ns) // SLOT_NS
        self._events_until(t_ns)

    def _advance(self, window: Window, pending: Pending, n: int) -> _Advanced:
        result: _Advanced = _advance(window, self._constants, self._rates, pending, n)
        return result


_UM2_PER_CM2 = 1e8
_PIXELS = 1 << 20  # first index of the numbers that a track's pixels draw


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
def path(track: _Track, width: int, height: int, pixel: Int64s) -> int:
    """Write the pixels under a track into `pixel`, (width + height + 2,) int64, in order; return their number.

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
def _add_track(base: np.uint64, t_ns: int, pixel: Int64s, chip: _Chip, pending: Pending, n: int) -> int:
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
def _draw_particles(slot: int, chip: _Chip, pixel: Int64s, dead: Mask, pending: Pending, n: int) -> tuple[Pending, int]:
    """Add the particles of a slot to `pending` from n on."""
    slot_base = stream(chip.root, slot)
    t, k = 0.0, 0
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
        n = _add_track(base, slot * SLOT_NS + int(t * SLOT_NS), pixel[:alive], chip, pending, n)
        k += 1


@cached_entry
def _advance_particles(
    window: Window, chip: _Chip, dead: Mask, pending: Pending, n: int
) -> tuple[tuple[Any, ...], int, npt.NDArray[np.uint64]]:
    """Draw the slots up to t1; return the events pending after t1, and the packed events before it, unsorted."""
    pixel = np.empty(chip.width + chip.height + 2, np.int64)
    for slot in range(window.slot, -(-window.t1_ns // SLOT_NS)):
        pending, n = _draw_particles(slot, chip, pixel, dead, pending, n)
    keys = np.empty(n + 1, np.uint64)
    released, remaining = release(window, pending, n, keys)
    return pending[0:], remaining, keys[:released]


class Particles(SlottedEvents):
    """The events that particles raise on a chip.

    Parameters
    ----------
    parameters : the sensor, with `radiation.hits_per_cm2_s` > 0.
    seed : keys the particles.
    dead : pixels that raise no events, (n,) int64.
    """

    def __init__(self, parameters: SensorParameters, seed: int, dead: Int64s) -> None:
        p, r = parameters, parameters.radiation
        super().__init__(p.width * p.height)
        self._dead = np.zeros(p.width * p.height, np.bool_)
        self._dead[dead] = True
        root, gap = root_of(seed, Purpose.PARTICLES), 1 / (hits_per_second(p) * SLOT_NS * 1e-9)
        depth_px, recovery_ns = r.depth_um / r.pixel_pitch_um, r.recovery_us * 1000
        self._chip = _Chip(root, gap, p.width, p.height, depth_px, r.off_share, recovery_ns)

    def _advance(self, window: Window, pending: Pending, n: int) -> _Advanced:
        result: _Advanced = _advance_particles(window, self._chip, self._dead, pending, n)
        return result
