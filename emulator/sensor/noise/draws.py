"""Compiled loops of `points`: each pixel's next candidate, thinned by the rates of first passage from its level.

A pixel has one candidate ahead, at a random time of a rate that is at least that of its noise events. When its time has
come, the rates in the light and at the level of that time decide on an event. Only pixels with a candidate soon are
looked at, by lists of pixels:

    soon     those whose candidate may come before the next horizon, a multiple of 2^26 ns
    window   those whose candidate may come before the window's end, a multiple of 2^22 ns; a step searches these
    moved    those with crossings of the pixels' own: their levels are read at the next windows until they rest

A pixel is in `soon` or in `window` once at most. State of the pixels, one row for each, so that a pixel's values come
with one access to memory:

    times    (pixels, 3) int64: NEXT candidate; READ, time of the level that was read; CROSSED, the last crossing
    levels   (pixels, 4) float32: OFFSET of the reference from that of the pixels' method, SEEN, the level of the
             comparator when it was read, DRIFT of it by leak in ln units a second, and the candidate's RATE in Hz
    limits   (pixels, 3) float32: the thresholds, infinite for dead pixels; the noise's rms over that of the sensor
    crossed  (pixels,) uint32: crossings of the pixel's own until now, which key their random numbers: the times of the
             crossings in float32 differ by nanoseconds with the steps
    place    (pixels,) uint8: bits of the lists that a pixel is in
    counts   (COUNTS,) int64: see `Count`

Fast because a pixel's state is requested from memory eight pixels ahead (`_request`; pixels that fire one after another
lie far apart: 1.7 times as fast at 346 x 260), and a pixel far from its thresholds needs neither light nor table.
"""

from __future__ import annotations

import math
from enum import IntEnum
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.noise.passages import rates_between
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel
from emulator.sensor.numerics.elementary import fetch
from emulator.sensor.numerics.keyed import high, low, normal_from, stream, unit, word

WINDOW_NS, HORIZON_NS = 1 << 22, 1 << 26
NEVER_NS = 1 << 61
"""Time of the next candidate of a pixel that has none."""

NEXT, READ, CROSSED = range(3)
OFFSET, SEEN, DRIFT, RATE = range(4)
_SCALE = 2

_NEAR, _WINDOW, _MOVED = (np.uint8(bit) for bit in (1, 2, 4))
_LOOKED = np.uint8(8)  # since the last crossing, within its step
_LEAST_HZ = 2.0**-5  # of candidates: a level that moves without crossings is read again as often as this
_LEAST_RATE_HZ = 1e-6  # of events, in a division
_LEAST_DRIFT = 1e-9  # ln units a second: slower leaks leave all of the history
_SETTLED = 5.0  # longest mean stays of a level after which its start makes one percent
_FAR = 8.0  # deviations of a threshold from which the rate is below the least one at any bandwidth up to 1e9 Hz
_AHEAD = 8  # pixels whose state is requested from memory before it is needed
_UNREADABLE_HZ = 64.0  # of candidates in light that is not finite, so that finite light is noticed
_MARGIN = 1.25
_RESTING = 0.02  # change of level between two windows, in thresholds, below which it is at rest
_LARGEST = np.finfo(np.float32).max
_ONE = np.uint64(1)
_TWO = np.int64(2)

_Int64s = npt.NDArray[np.int64]
_Float32s = npt.NDArray[np.float32]
_Words = npt.NDArray[np.uint64]
_Pixels = npt.NDArray[np.int64]
_Events = tuple[_Int64s, npt.NDArray[np.uint32], npt.NDArray[np.bool_]]


class Count(IntEnum):
    """Entries of `counts`: the pixels in each list, and the packed events of the step."""

    NEAR = 0
    WINDOW = 1
    MOVED = 2
    FOUND = 3
    DONE = 4


class Constants(NamedTuple):
    """The sensor's noise: streams of candidates and of looks, light to corner frequency, noise, refractory period."""

    root: np.uint64
    root_of_looks: np.uint64
    dark: float
    hz_at_reference: float
    hz_min: float
    hz_max: float
    rms: float
    corner_hz: float
    refractory_ns: int


class PixelNoise(NamedTuple):
    """State of the pixels, see above."""

    times: _Int64s
    levels: _Float32s
    limits: _Float32s
    crossed: npt.NDArray[np.uint32]
    place: npt.NDArray[np.uint8]


class Lists(NamedTuple):
    """Lists of pixels, (pixels,) each, and the numbers in them."""

    soon: _Pixels
    window: _Pixels
    moved: _Pixels
    counts: _Int64s


class Setting(NamedTuple):
    """The light of the step, (pixels,), the constants, and the table of first passages."""

    light: _Float32s
    constants: Constants
    table: _Float32s


class Packed(NamedTuple):
    """Packed events, [time since t0 | pixel | on]."""

    keys: _Words
    t0_ns: int
    pixel_bits: int


class ReadPixels(NamedTuple):
    """Pixels with their levels and drifts as they were read just now; without these, levels stay as they are."""

    pixels: _Pixels
    level: _Float32s
    drift: _Float32s


class Thresholds(NamedTuple):
    """Thresholds of a pixel, ln units; infinite for a dead one."""

    on: float
    off: float


class Figures(NamedTuple):
    """The noise of a pixel in a light: deviation, ln units, 0 where the light is not finite; and 1 / tau, 1/s."""

    sigma: float
    per_s: float


@kernel
def _thresholds(pixel: int, s: PixelNoise) -> Thresholds:
    """Return the thresholds of a pixel."""
    return Thresholds(np.float64(s.limits[pixel, 0]), np.float64(s.limits[pixel, 1]))


@kernel
def _figures(light: float, scale: float, c: Constants) -> Figures:
    """Return the noise of a pixel at a light."""
    if not abs(light) <= _LARGEST:
        return Figures(0.0, 1.0)
    hz = min(max(c.hz_at_reference * (max(light, 0.0) + c.dark), c.hz_min), c.hz_max)
    passed = c.corner_hz / (c.corner_hz + hz)
    return Figures(c.rms * scale * math.sqrt(passed), 2 * math.pi * hz * passed)


@kernel
def _rates(level: float, limits: Thresholds, noise: Figures, table: _Float32s) -> tuple[float, float]:
    """Return the ON and the OFF rate, Hz, for a reference at `level` above the signal."""
    if noise.sigma <= 0:
        return 0.0, 0.0
    up, down = rates_between((limits.on + level) / noise.sigma, (limits.off - level) / noise.sigma, table)
    return up * noise.per_s, down * noise.per_s


@kernel
def _candidates_hz(total: float) -> float:
    """Return the rate of candidates for a rate of events: a power of two, so that it is the same whatever the steps."""
    _, exponent = math.frexp(max(total * _MARGIN, _LEAST_HZ / 2))
    return math.ldexp(1.0, exponent)


@kernel
def _wait_ns(half: np.uint64, hz: float) -> int:
    return 1 + int(-math.log(unit(half)) / hz * 1e9)


@kernel
def _seen(t_ns: int, pixel: int, s: PixelNoise) -> float:
    """Return the level of the comparator at a time, as it was last read."""
    since_s = (t_ns - s.times[pixel, READ]) * 1e-9
    return float(np.float64(s.levels[pixel, SEEN]) + s.levels[pixel, DRIFT] * since_s)


@kernel
def _set_again(level: float, noise: Figures, c: Constants, bits: np.uint64) -> float:
    """Return the level to which the refractory period's end sets a reference, from a comparator at `level`."""
    decay = math.exp(-noise.per_s * c.refractory_ns * 1e-9)
    return float(level * decay + noise.sigma * math.sqrt(1 - decay * decay) * normal_from(bits))


@kernel
def _run(pixel: int, until_ns: int, w: Setting, s: PixelNoise, out: Packed, n: int) -> int:
    """Run a pixel's candidates before a time; return the number of events in `out`, which may be full."""
    c, keys = w.constants, out.keys
    if s.times[pixel, NEXT] >= until_ns:
        return n
    base, noise = stream(c.root, pixel), _figures(w.light[pixel], s.limits[pixel, _SCALE], c)
    limits = _thresholds(pixel, s)
    t_ns = s.times[pixel, NEXT]
    while t_ns < until_ns and n < keys.size:
        bits, seen = word(base, _TWO * t_ns), _seen(t_ns, pixel, s)
        level = s.levels[pixel, OFFSET] - seen
        on_hz, off_hz = _rates(level, limits, noise, w.table)
        chance = unit(high(bits)) * s.levels[pixel, RATE]
        if chance < on_hz + off_hz:
            on = chance < on_hz
            keys[n] = np.uint64(t_ns - out.t0_ns) << np.uint64(out.pixel_bits + 1)
            keys[n] |= np.uint64(pixel) << _ONE | np.uint64(on)
            n += 1
            level = _set_again(level + limits.on if on else level - limits.off, noise, c, word(base, _TWO * t_ns + 1))
            s.levels[pixel, OFFSET] = level + seen
            on_hz, off_hz = _rates(level, limits, noise, w.table)
            t_ns += c.refractory_ns
        hz = _candidates_hz(on_hz + off_hz) if noise.sigma > 0 else _UNREADABLE_HZ
        s.levels[pixel, RATE] = hz
        t_ns += _wait_ns(low(bits), hz)
    s.times[pixel, NEXT] = t_ns
    return n


@cached_entry
def draw_first(t_ns: int, history_ns: int, w: Setting, s: PixelNoise) -> None:
    """Draw the first candidates of all pixels, `history_ns` before a time; levels have been read for this time.

    A leak has moved the levels in that time: it is no longer than the leak takes for half a threshold. Nor is it longer
    than some mean stays at the level where events are rarest, which is the time in which a pixel's level settles: the
    many events of the noisiest pixels after it would change nothing. It must not end with some number of events: levels
    just after an event are not those of a random time.
    """
    light, c = w.light, w.constants
    for pixel in range(light.size):
        if s.limits[pixel, 0] > _LARGEST:
            s.times[pixel, NEXT] = NEVER_NS
            continue
        limits = _thresholds(pixel, s)
        leak = max(abs(np.float64(s.levels[pixel, DRIFT])), _LEAST_DRIFT)
        noise = _figures(light[pixel], s.limits[pixel, _SCALE], c)
        rarest_hz = max(sum(_rates((limits.off - limits.on) / 2, limits, noise, w.table)), _LEAST_RATE_HZ)
        start_ns = t_ns - int(min(np.float64(history_ns), 0.5e9 * limits.on / leak, _SETTLED * 1e9 / rarest_hz))
        level = s.levels[pixel, OFFSET] - _seen(start_ns, pixel, s)
        on_hz, off_hz = _rates(level, limits, noise, w.table)
        hz = _candidates_hz(on_hz + off_hz) if abs(light[pixel]) <= _LARGEST else _UNREADABLE_HZ
        s.levels[pixel, RATE] = hz
        s.times[pixel, NEXT] = start_ns + _wait_ns(low(word(stream(c.root_of_looks, pixel), start_ns)), hz)


@cached_entry
def settle(first: int, last: int, until_ns: int, w: Setting, s: PixelNoise) -> None:
    """Run the candidates of pixels first to last - 1 before a time without events: they leave the pixels' levels."""
    out = Packed(np.empty(64, np.uint64), NONE, NONE)
    for pixel in range(first, last):
        while s.times[pixel, NEXT] < until_ns:
            _run(pixel, until_ns, w, s, out, NONE)


@kernel
def _request(pixel: int, w: Setting, s: PixelNoise) -> None:
    """Request a pixel's state from memory some pixels before it is needed: they lie far apart."""
    fetch(s.times, 3 * pixel)
    fetch(s.levels, 4 * pixel)
    fetch(s.limits, 3 * pixel)
    fetch(s.crossed, pixel)
    fetch(s.place, pixel)
    fetch(w.light, pixel)


@kernel
def _crossed(pixel: int, on: bool, t_ns: int, w: Setting, s: PixelNoise) -> bool:
    """Move a pixel's reference by its own crossing; return whether it fires, which noise may have done before."""
    c = w.constants
    offset, step = s.levels[pixel, OFFSET], s.limits[pixel, 0] if on else -s.limits[pixel, 1]
    s.levels[pixel, SEEN] = 0
    s.times[pixel, READ] = s.times[pixel, CROSSED] = t_ns
    early = offset * step > step * step / 2
    s.crossed[pixel] += np.uint32(1)
    s.place[pixel] &= ~_LOOKED
    if early:
        s.levels[pixel, OFFSET] = offset - step
    elif c.refractory_ns > 0:
        bits = word(stream(c.root_of_looks, pixel), _TWO * np.int64(s.crossed[pixel]) + 1)
        s.levels[pixel, OFFSET] = _set_again(0.0, _figures(w.light[pixel], s.limits[pixel, _SCALE], c), c, bits)
    else:
        s.levels[pixel, OFFSET] = 0
    return not early


@kernel
def _run_and_look(pixel: int, times_ns: tuple[int, int], w: Setting, s: PixelNoise, out: Packed, n: int) -> int:
    """Run a pixel's candidates before a crossing at the second of two times; return as `_run`.

    After the crossing before, it is looked at in the next window, if that is not before the first of the times.
    """
    opened_ns, until_ns = times_ns
    if s.place[pixel] & (_MOVED | _LOOKED) == _MOVED:
        look_ns = (s.times[pixel, CROSSED] // WINDOW_NS + 1) * WINDOW_NS
        if opened_ns <= look_ns < until_ns:
            n = _run(pixel, look_ns, w, s, out, n)
            if s.times[pixel, NEXT] < look_ns:
                return n
            _draw_again(pixel, look_ns, w, s)
            s.place[pixel] |= _LOOKED
    return int(_run(pixel, until_ns, w, s, out, n))


@cached_entry
def cross(  # noqa: PLR0913, PLR0917
    crossings: _Events, opened_ns: int, w: Setting, s: PixelNoise, lists: Lists, out: Packed,
    fires: npt.NDArray[np.bool_],
) -> bool:  # fmt: skip
    """Apply the pixels' own crossings from the DONE one on, each after its pixel's earlier candidates.

    `opened_ns` is the end of the last window that was opened: a pixel that crosses again after the next one's start is
    looked at there first, as it would be in short steps. Writes which of them fire. Returns False where the events are
    too many for `out`: call again with more room.
    """
    (t_ns, pixels, on), counts = crossings, lists.counts
    n = counts[Count.FOUND]
    for k in range(counts[Count.DONE], t_ns.size):
        pixel = np.int64(pixels[k])
        _request(np.int64(pixels[min(k + _AHEAD, t_ns.size - 1)]), w, s)
        n = _run_and_look(pixel, (opened_ns, t_ns[k]), w, s, out, n)
        if s.times[pixel, NEXT] < t_ns[k]:
            counts[Count.FOUND], counts[Count.DONE] = n, k
            return False
        fires[k] = _crossed(pixel, on[k], t_ns[k], w, s)
        if not s.place[pixel] & _MOVED:
            s.place[pixel] |= _MOVED
            lists.moved[counts[Count.MOVED]] = pixel
            counts[Count.MOVED] += 1
    counts[Count.FOUND], counts[Count.DONE] = n, NONE
    return True


@kernel
def _draw_again(pixel: int, window_ns: int, w: Setting, s: PixelNoise) -> None:
    """Draw a pixel's candidate again at a window's start, if their rate has changed."""
    limits, c = _thresholds(pixel, s), w.constants
    level, scale = s.levels[pixel, OFFSET] - _seen(window_ns, pixel, s), s.limits[pixel, _SCALE]
    if min(limits.on + level, limits.off - level) > _FAR * c.rms * scale:
        hz = _LEAST_HZ  # most pixels in motion: neither their light nor the table is needed
    else:
        on_hz, off_hz = _rates(level, limits, _figures(w.light[pixel], scale, c), w.table)
        hz = _candidates_hz(on_hz + off_hz)
    if hz != s.levels[pixel, RATE] and limits.on <= _LARGEST:
        s.levels[pixel, RATE] = hz
        bits = word(stream(c.root_of_looks, pixel), _TWO * window_ns)
        s.times[pixel, NEXT] = window_ns + _wait_ns(low(bits), hz)


@kernel
def _read(pixel: int, t_ns: int, level: float, drift: float, s: PixelNoise) -> float:
    """Store a level that was read, NaN in the refractory period; return its distance from what was expected."""
    if level != level:
        return 0.0
    moved = level - _seen(t_ns, pixel, s)
    s.levels[pixel, SEEN], s.levels[pixel, DRIFT] = level, drift
    s.times[pixel, READ] = t_ns
    return float(moved)


@cached_entry
def look_again(times_ns: tuple[int, int], read: ReadPixels, w: Setting, s: PixelNoise, lists: Lists) -> None:
    """Draw the candidates of `moved` pixels again at the first of two times, a window's start.

    `read` has their levels and drifts at the second time. Those that have come to rest leave the list; those that cross
    later in the step are left for a later window.
    """
    window_ns, t_ns = times_ns
    counts, remaining = lists.counts, NONE
    for k in range(counts[Count.MOVED]):
        pixel = lists.moved[k]
        _request(lists.moved[min(k + _AHEAD, counts[Count.MOVED] - 1)], w, s)
        if s.times[pixel, CROSSED] >= window_ns:
            lists.moved[remaining] = pixel
            remaining += 1
            _put_near(pixel, window_ns, s, lists)  # looked at before its crossing, its candidate may be in this window
            continue
        moved = _read(pixel, t_ns, read.level[k], read.drift[k], s)
        _draw_again(pixel, window_ns, w, s)
        if abs(moved) > _RESTING * s.limits[pixel, 0]:
            lists.moved[remaining] = pixel
            remaining += 1
        else:
            s.place[pixel] &= ~_MOVED
        _put_near(pixel, window_ns, s, lists)
    counts[Count.MOVED] = remaining


@kernel
def _put_near(pixel: int, t_ns: int, s: PixelNoise, lists: Lists) -> None:
    """Add a pixel to `soon` if its candidate comes before the horizon after a time, and it is in no list."""
    if s.times[pixel, NEXT] < (t_ns // HORIZON_NS + 1) * HORIZON_NS and not s.place[pixel] & (_NEAR | _WINDOW):
        s.place[pixel] |= _NEAR
        lists.soon[lists.counts[Count.NEAR]] = pixel
        lists.counts[Count.NEAR] += 1


@cached_entry
def open_horizon(t_ns: int, s: PixelNoise, lists: Lists) -> None:
    """List the pixels whose candidates come before the horizon after a time."""
    for pixel in range(s.place.size):
        if s.times[pixel, NEXT] < NEVER_NS:
            _put_near(pixel, t_ns, s, lists)


@cached_entry
def open_window(window_ns: int, s: PixelNoise, lists: Lists) -> None:
    """Take the pixels whose candidates come before the end of the window at a time from `soon` to `window`."""
    counts, remaining = lists.counts, NONE
    end_ns = window_ns + WINDOW_NS
    horizon_ns = (window_ns // HORIZON_NS + 1) * HORIZON_NS
    for k in range(counts[Count.NEAR]):
        pixel = lists.soon[k]
        if s.times[pixel, NEXT] < end_ns:
            s.place[pixel] = s.place[pixel] & ~_NEAR | _WINDOW
            lists.window[counts[Count.WINDOW]] = pixel
            counts[Count.WINDOW] += 1
        elif s.times[pixel, NEXT] < horizon_ns:
            lists.soon[remaining] = pixel
            remaining += 1
        else:
            s.place[pixel] &= ~_NEAR
    counts[Count.NEAR] = remaining


@cached_entry
def due(until_ns: int, end_ns: int, s: PixelNoise, lists: Lists, out: _Pixels) -> int:
    """List the pixels with candidates before a time, at most the window's end; return their number.

    Pixels whose candidates come after the window's end leave its list.
    """
    counts = lists.counts
    remaining = n = NONE
    for k in range(counts[Count.WINDOW]):
        pixel = lists.window[k]
        t_ns = s.times[pixel, NEXT]
        out[n] = pixel
        n += t_ns < until_ns
        if t_ns < end_ns:
            lists.window[remaining] = pixel
            remaining += 1
        else:
            s.place[pixel] &= ~_WINDOW
            _put_near(pixel, end_ns - 1, s, lists)
    counts[Count.WINDOW] = remaining
    return int(n)


@cached_entry
def fire(pixels: ReadPixels, times_ns: tuple[int, int], w: Setting, s: PixelNoise, lists: Lists, out: Packed) -> bool:
    """Run the candidates of the pixels that are due, from the DONE one on, before the first of two times.

    Levels and drifts are those at the second time. Returns False where `out` is full: call again with more room.
    """
    counts, (until_ns, t_ns) = lists.counts, times_ns
    n = counts[Count.FOUND]
    for k in range(counts[Count.DONE], pixels.pixels.size):
        pixel = pixels.pixels[k]
        _request(pixels.pixels[min(k + _AHEAD, pixels.pixels.size - 1)], w, s)
        if pixels.level.size:
            _read(pixel, t_ns, pixels.level[k], pixels.drift[k], s)
        n = _run(pixel, until_ns, w, s, out, n)
        if s.times[pixel, NEXT] < until_ns:
            counts[Count.FOUND], counts[Count.DONE] = n, k
            return False
    counts[Count.FOUND], counts[Count.DONE] = n, NONE
    return True


@cached_entry
def insert(keys: _Words, t0_ns: int, pixel_bits: int, crossings: _Events, out: _Events) -> None:
    """Write sorted keys and crossings to `out`, sorted by (time, pixel); of equals, crossings come first."""
    (at_ns, at, on), (out_ns, out_at, out_on) = crossings, out
    shift, mask = np.uint64(pixel_bits + 1), (_ONE << np.uint64(pixel_bits)) - _ONE
    k = n = 0
    for key in keys:
        t_ns, pixel = t0_ns + np.int64(key >> shift), (key >> _ONE) & mask
        while k < at_ns.size and (at_ns[k] < t_ns or (at_ns[k] == t_ns and np.uint64(at[k]) <= pixel)):
            out_ns[n], out_at[n], out_on[n] = at_ns[k], at[k], on[k]
            k, n = k + 1, n + 1
        out_ns[n], out_at[n], out_on[n] = t_ns, pixel, key & _ONE != 0
        n += 1
    while k < at_ns.size:
        out_ns[n], out_at[n], out_on[n] = at_ns[k], at[k], on[k]
        k, n = k + 1, n + 1
