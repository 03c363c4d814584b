"""Noise events as a point process: drawn by their rate, at a cost proportional to their number.

Noise fires a pixel in bursts of events of alternating polarity: an excursion over a threshold and its return, or a
level midway between two passages. So there are primaries, ON or OFF, and each event is followed by one of the other
polarity with probability q, after the refractory period and an exponential time. The law of first passages (`law`)
gives, in each light, the ON and the OFF rate, the share of events whose successor has the other polarity, 2 q - 1, and
the mean time within a burst. The primaries' rate is (1 - q) of all, their ON share that which makes the ON share of
all, in the light where there is most noise.

All random numbers are keyed by a slot of 1024 us of stream time, never by the step. The primaries of a slot:

    gaps       exponential, of the total rate W of all pixels, W_p being the highest rate of a pixel in any light
    pixel      by a table of aliases (Walker 1977) in proportion to W_p
    thinning   selected with probability rate / W_p, the rate being that in the light at the end of the event's step

The numbers that do not depend on the light are drawn for sixteen slots at a time, a window; a step thins the candidates
in it. When a sensor starts, bursts are pending already: as many as there are at any time in still light.

The next event of a burst is drawn when the one before leaves, from bits that belong to the burst, in the light of that
step. An array of still light thus gives the same noise, bit for bit, whatever the steps. Left out: the pixel's level
stays, a noise event starts no refractory period, and the events of a moving scene are not shifted (noise makes them
earlier by up to two rms over the contrast rate). Rates, polarities and intervals are those of the law; see `law` for
what the law leaves out. The light must change by more than 0.3 rms in a time constant; else use the grid grade.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.sources import SLOT_NS
from emulator.sensor.noise.draws import (
    RING,
    STATE_SIZE,
    WHEN,
    WINDOW_SLOTS,
    State,
    draw_window,
    fire,
    insert,
    spread,
    take_window,
)
from emulator.sensor.noise.law import bandwidth_hz, of_array
from emulator.sensor.numerics.compiled import cached_entry
from emulator.sensor.numerics.keyed import Purpose, root_of, uniform, words
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined
from emulator.sensor.presets import SensorParameters

__all__ = ["NoiseEvents", "under_way"]


_MOST_BURSTS = 16  # of a pixel
_DRAWS = 2 * _MOST_BURSTS + 1

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]


def _nodes(light: _Float32s, lights: _Float32s) -> _Floats:
    """Return the place of each light among the nodes of the table."""
    dark, at_reference, least, most, a_fold, last = lights.astype(np.float64)
    hz = np.clip(at_reference * (np.maximum(light, 0) + dark), least, most)
    return np.asarray(np.clip(np.log(hz / least) * a_fold, 0, last))


def _rates_hz(table: _Float32s, row: _Float32s, node: _Floats) -> _Floats:
    """Return the primaries' rates, by bilinear interpolation."""
    i, j = row.astype(np.int64), node.astype(np.int64)
    y, x = row - i, node - j
    upper = table[i, j] * (1 - x) + table[i, j + 1] * x
    lower = table[i + 1, j] * (1 - x) + table[i + 1, j + 1] * x
    return np.asarray(np.exp(upper * (1 - y) + lower * y))


def _poisson(draw: _Floats, mean: _Floats) -> npt.NDArray[np.int64]:
    """Return the numbers that have these means, at most `_MOST_BURSTS`, from uniform ones."""
    term = np.exp(-mean)
    below, number = term.copy(), np.zeros(mean.size, np.int64)
    for k in range(1, _MOST_BURSTS + 1):
        number += draw > below
        term = term * mean / k
        below += term
    return number


def under_way(
    light: _Float32s, row: _Float32s, tables: tuple[_Float32s, _Float32s], seed: int, slot: tuple[int, int]
) -> npt.NDArray[np.int64]:
    """Return the next events of bursts under way at the start of a slot, (3, n) int64 as `soon` of `draws`.

    Parameters
    ----------
    light : (pixels,), first light; not finite: no burst.
    row : (pixels,), row of the table by threshold; NaN: no burst.
    tables : table and lights, see `draws`.
    slot : its number and its first time, ns.
    """
    pixel = np.flatnonzero(np.isfinite(light) & np.isfinite(row))
    table, lights = tables
    node = _nodes(light[pixel], lights)
    nearest = (node + 0.5).astype(np.int64)
    again, wait_ns = (table[k, nearest].astype(np.float64) for k in (-2, -1))
    expected = _rates_hz(table, row[pixel], node) * wait_ns * 1e-9 * again / (1 - again)
    first = _DRAWS * slot[0]
    bursts = _poisson(uniform(seed, Purpose.NOISE_BURST, pixel, first), expected)
    draw = np.arange(bursts.sum()) - np.repeat(np.cumsum(bursts) - bursts, bursts)
    pixel, wait_ns = np.repeat(pixel, bursts), np.repeat(wait_ns, bursts)
    bits = words(seed, Purpose.NOISE_BURST, pixel, first + 2 * draw + 1)
    wait_ns = -wait_ns * np.log(uniform(seed, Purpose.NOISE_BURST, pixel, first + 2 * draw + 2))
    on = (bits >> np.uint64(20)).astype(np.int64) & 1
    return np.stack([slot[1] + wait_ns.astype(np.int64), pixel << 1 | on, bits.view(np.int64)])


_FASTEST_HZ = 1e9
_LOG_STEP = 0.1  # between nodes of the table, ln f
_THRESHOLDS = 33
_NEVER = -80.0  # ln of a rate of nothing
_LEAST_AGAIN, _MOST_AGAIN = 0.01, 0.98  # of q: bursts are finite
_LEAST_WAIT = 1.4  # tau, mean of an excursion's return


@cached_entry
def _aliases(weight: _Floats) -> tuple[_Floats, npt.NDArray[np.uint32]]:
    """Return for each pixel the probability of its own, and the alternative pixel (Walker 1977, Vose 1991)."""
    n = weight.size
    own, alias = weight * (n / weight.sum()), np.arange(n).astype(np.uint32)
    poor, rich = np.flatnonzero(own < 1), np.flatnonzero(own >= 1)
    n_poor, n_rich = poor.size, rich.size
    room = np.empty(n, np.int64)
    room[:n_poor] = poor
    while n_poor and n_rich:
        low_one, high_one = room[n_poor - 1], rich[n_rich - 1]
        alias[low_one] = high_one
        own[high_one] -= 1 - own[low_one]
        n_poor -= 1
        if own[high_one] < 1:
            room[n_poor] = high_one
            n_poor, n_rich = n_poor + 1, n_rich - 1
    for k in range(n_poor):
        own[room[k]] = 1.0
    return own, alias


def _nodes_hz(p: SensorParameters) -> _Floats:
    """Return the corner frequencies of the table, Hz."""
    if math.isinf(p.corner_hz_at_reference):
        return np.full(2, np.inf)
    lowest, highest = math.log(p.corner_min_hz), math.log(min(p.corner_max_hz, _FASTEST_HZ))
    nodes = np.arange(max(2, math.ceil((highest - lowest) / _LOG_STEP) + 2))
    return np.asarray(np.exp(lowest + _LOG_STEP * nodes))


class _Tables(NamedTuple):
    """The primaries' log rate over (thresholds, ln f), q and the mean wait in ns over ln f, the primaries' ON share."""

    log_rate: _Floats
    again: _Floats
    wait_ns: _Floats
    on_share: float


def _tables(p: SensorParameters, thresholds: _Floats) -> _Tables:
    f_hz = _nodes_hz(p)
    law = of_array(p, thresholds[:, None], f_hz)
    middle = thresholds.size // 2
    again = np.minimum(2 * law.opposite[middle] - 1, _MOST_AGAIN)
    again[again < _LEAST_AGAIN] = 0
    dead_s = p.refractory_us * 1e-6
    least_s = _LEAST_WAIT / (2 * np.pi * bandwidth_hz(p, f_hz))
    wait_s = np.maximum(law.gap[middle] - dead_s, least_s)
    total_hz = law.on + law.off
    with np.errstate(divide="ignore"):
        log_rate = np.maximum(np.log(total_hz * (1 - again)), _NEVER)
    most = int(total_hz[middle].argmax())
    on_share = law.on[middle, most] / total_hz[middle, most] if total_hz[middle, most] else 0.5
    first_on = (on_share * (1 + again[most]) - again[most]) / (1 - again[most])
    return _Tables(log_rate, again, wait_s * 1e9, float(np.clip(first_on, 0, 1)))


def _lights(p: SensorParameters, nodes: int) -> _Float32s:
    values = p.dark_current_relative, p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _FASTEST_HZ)
    if math.isinf(p.corner_hz_at_reference):
        values = p.dark_current_relative, 1.0, 1.0, 1.0
    return np.array([*values, 1 / _LOG_STEP, nodes - 1.001], np.float32)


class _Model:
    """The constants, in the layout that the loops of `draws` use."""

    def __init__(self, p: SensorParameters, seed: int, thresholds: _Floats) -> None:
        live = np.isfinite(thresholds)
        lowest, highest = thresholds[live].min(), thresholds[live].max() * (1 + 1e-6)
        log_rate, again, wait_ns, on_share = _tables(p, np.linspace(lowest, highest, _THRESHOLDS))
        row = np.where(live, (thresholds - lowest) / (highest - lowest) * (_THRESHOLDS - 1), 0)
        row = np.minimum(row, _THRESHOLDS - 1.001)
        log_highest = log_rate.max(axis=1)
        weight = np.where(live, np.exp(np.interp(row, np.arange(_THRESHOLDS), log_highest)), 0)
        own, other = _aliases(weight)
        share = np.minimum(own * 2.0**32, 2.0**32 - 1).astype(np.uint64)
        self.alias = share << np.uint64(32) | other
        self.seed, self.row_if_live = seed, np.where(live, row, np.nan).astype(np.float32)
        self.row, self.log_highest = row.astype(np.float32), log_highest.astype(np.float32)
        self.table = np.vstack([log_rate, again, wait_ns]).astype(np.float32)
        self.lights = _lights(p, wait_ns.size)
        self.on_share = on_share
        self.root = root_of(seed, Purpose.NOISE_EVENTS)
        self.mean_gap = float(1 / (weight.sum() * SLOT_NS * 1e-9))


class NoiseEvents:
    """The noise events of an array.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor, with `noise.rms` > 0.
    seed : int
        Keys all random numbers.
    thresholds : (pixels,) float64
        Mean of each pixel's two thresholds, ln units; infinite for dead pixels. At least one pixel is live.
    """

    def __init__(self, parameters: SensorParameters, seed: int, thresholds: _Floats) -> None:
        self._pixel_bits = max(1, (thresholds.size - 1).bit_length())
        self._model = _Model(parameters, seed, thresholds)
        expected = WINDOW_SLOTS / self._model.mean_gap
        self._reserve_candidates(int(expected + 8 * math.sqrt(expected)) + 600)
        self._soon, self._far = np.empty((WINDOW_SLOTS, 3, 0), np.int64), np.empty((3, 0), np.int64)
        self._ring = np.empty((RING, 3, 0), np.int64)
        self._keys = np.empty(0, np.uint64)
        self._state = np.zeros(STATE_SIZE, np.int64)
        self._state[State.REFRACTORY_NS] = round(parameters.refractory_us * 1000)
        self._state[State.PIXEL_BITS] = self._pixel_bits
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`, with the bursts that are under way in the light of the first step."""
        self._started = False
        self._t_ns, self._slot = t_ns, t_ns // SLOT_NS
        self._window_ns = self._slot * SLOT_NS
        self._state[[State.FIRST, State.COUNT, State.TURN]] = 0
        self._state[State.FAR :] = 0
        self._state[State.WINDOW_NS] = self._window_ns

    def step(self, light: _Float32s, t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`, under `light`, (pixels,) float32."""
        return self.add_to(NO_CROSSINGS, light, t_ns)

    def add_to(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Return a step's `crossings` with the noise events up to, and without, `t_ns` among them."""
        if t_ns <= self._t_ns:
            return crossings
        if not self._started:
            self._start(light)
        if t_ns <= self._window_ns:
            return self._advance(crossings, light, t_ns)
        parts, k = [], 0
        while self._t_ns < t_ns:
            if self._t_ns >= self._window_ns:
                self._open_window()
            end_ns = min(t_ns, self._window_ns)
            n = len(crossings) if end_ns == t_ns else int(np.searchsorted(crossings.t_ns, end_ns))
            piece = Crossings(crossings.t_ns[k:n], crossings.pixel[k:n], crossings.on[k:n])
            parts.append(self._advance(piece, light, end_ns))
            k = n
        whole = joined(parts)
        return Crossings(whole.t_ns, whole.pixel, whole.on, crossings.lost_in_pixel)

    def _start(self, light: _Float32s) -> None:
        m, state, self._started = self._model, self._state, True
        far = under_way(light, m.row_if_live, (m.table, m.lights), m.seed, (self._slot, self._slot * SLOT_NS))
        # In the middle of a window, after `follow`, its candidates come without a further reserve.
        self._far = _reserve(far, far.shape[1] + int(state[State.COUNT]) + 1)
        state[State.FAR] = far.shape[1]

    def _reserve_candidates(self, candidates: int) -> None:
        self._candidates, self._chances = np.empty((3, candidates), np.int64), np.empty((2, candidates), np.float32)

    def follow(self, parameters: SensorParameters, thresholds: _Floats) -> None:
        """Apply changed parameters from the present time on; `thresholds` as in the constructor.

        The present window's candidates are drawn again, and those before the present time left out. Bursts that were
        under way end; those of the new figures are under way from the window's end on, at most 16 ms later.
        """
        self._model, self._started, state = _Model(parameters, self._model.seed, thresholds), False, self._state
        state[State.REFRACTORY_NS] = round(parameters.refractory_us * 1000)
        state[State.TURN] = 0
        state[State.FAR :] = 0
        if self._t_ns < self._window_ns:
            n = self._draw(self._slot - WINDOW_SLOTS)
            self._reserve_lists(n + 1)
            state[State.FIRST], state[State.COUNT] = np.searchsorted(self._candidates[WHEN, :n], self._t_ns), n

    def _draw(self, slot: int) -> int:
        """Draw the candidates of the window that begins with a slot; return their number."""
        m = self._model
        slots = slot, WINDOW_SLOTS, m.root, m.mean_gap, m.on_share
        while (n := draw_window(slots, m.alias, m.row, m.log_highest, self._candidates, self._chances)) < 0:
            self._reserve_candidates(2 * self._candidates.shape[1])
        return int(n)

    def _reserve_ring(self, needed: int) -> None:
        self._ring = _grown(self._ring, self._state[State.RING :], needed)

    def _reserve_lists(self, due: int) -> None:
        """Make room for `due` more events, wherever they may go."""
        state = self._state
        self._soon = _grown(self._soon, state[State.SOON : State.RING], due)
        self._far = _reserve(self._far, int(state[State.FAR]) + due)
        self._reserve_ring(int(state[State.RING :].max()) + due)
        if self._keys.size < 2 * due:
            self._keys = np.empty(4 * due, np.uint64)

    def _open_window(self) -> None:
        """Draw the candidates of the next window, and reserve space for all events that may follow from them."""
        state, n = self._state, self._draw(self._slot)
        while state[State.TURN] == 0 and not spread(self._ring, self._far, state):
            self._reserve_ring(2 * self._ring.shape[2] + n + 1)  # also where there is none, and no candidate
        self._reserve_lists(int(state[State.RING + state[State.TURN]]) + n + 1)
        state[State.FIRST], state[State.COUNT] = 0, n
        take_window(self._soon, self._ring, state)
        self._slot += WINDOW_SLOTS
        self._window_ns = self._slot * SLOT_NS

    def _advance(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Move on within the window, and merge its events with the crossings."""
        t0_ns, self._t_ns = self._t_ns, t_ns
        m, state, bits = self._model, self._state, self._pixel_bits
        state[State.T0_NS], state[State.T1_NS] = t0_ns, t_ns
        drawn, seconds = (self._candidates, self._chances), (self._soon, self._ring, self._far)
        found = fire(light, drawn, (m.table, m.lights), seconds, self._keys, state)
        while state[State.FULL]:
            self._keys = np.concatenate([self._keys, np.empty_like(self._keys)])
            found += fire(light, drawn, (m.table, m.lights), seconds, self._keys[found:], state)
        if not found:
            return crossings
        keys = self._keys[:found]
        keys.sort()
        n = found + len(crossings)
        out = np.empty(n, np.int64), np.empty(n, np.uint32), np.empty(n, np.bool_)
        insert(keys, t0_ns, bits, (crossings.t_ns, crossings.pixel, crossings.on), out)
        return Crossings(*out, crossings.lost_in_pixel)


def _grown(lists: npt.NDArray[np.int64], counts: npt.NDArray[np.int64], needed: int) -> npt.NDArray[np.int64]:
    """Return lists, (k, 3, room), that have room for `needed` events each; `counts` are those in them."""
    if needed <= lists.shape[2]:
        return lists
    more = np.empty((lists.shape[0], 3, needed + needed // 4), np.int64)
    for place, n in enumerate(counts):
        more[place, :, :n] = lists[place, :, :n]
    return more


def _reserve(pending: npt.NDArray[np.int64], needed: int) -> npt.NDArray[np.int64]:
    """Return `pending`, (3, n), with at least `needed` columns."""
    n = pending.shape[1]
    return pending if needed <= n else np.concatenate([pending, np.empty((3, 2 * needed - n), np.int64)], axis=1)
