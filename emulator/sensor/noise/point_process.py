"""Noise events as a point process: drawn by their rate, at a cost proportional to their number.

An excursion of the noise over a threshold and its return are a pair of events of opposite polarity. So there are
primaries, ON or OFF by equal chance, and each has a second event with probability s, after 0.8 tau and an exponential
time of mean 1.4 tau (but no sooner than the refractory period lets it). The primaries' rate is 2 R / (1 + s), R the ON
rate of `law`, so that ON and OFF have the rate R each. Where the refractory period is longer than tau the level is
set again during the return, and pairs dissolve: s = e^(-1.6 t_ref / tau), which is within 0.1 of a simulated pixel.

All random numbers are keyed by a slot of 1024 us of stream time, never by the step. The primaries of a slot:

    gaps       exponential, of the total rate W of all pixels, W_p being the highest rate of a pixel in any light
    pixel      by a table of aliases (Walker 1977) in proportion to W_p
    thinning   selected with probability rate / W_p, the rate being that in the light at the end of the event's step

The numbers that do not depend on the light are drawn for sixteen slots at a time, a window; a step thins the candidates
in it.

An array of still light thus gives the same noise, bit for bit, whatever the steps. Left out: the pixel's level stays, a
noise event starts no refractory period, and the events of a moving scene are not shifted (noise makes them earlier by
up to two rms over the contrast rate). This is enough while pairs do not overlap, a >= 3.5 (4.5 with short refractory
periods), and the light changes by more than 0.3 rms in a time constant; else use the grid grade.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.slots import SLOT_NS
from emulator.sensor.noise.draws import State, draw_window, fire, insert, sort_in
from emulator.sensor.noise.law import bandwidth_hz, rate_over_bandwidth, rms
from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.keyed import Purpose, root_of
from emulator.sensor.pixels.array import Crossings
from emulator.sensor.pixels.merging import NO_CROSSINGS, joined
from emulator.sensor.presets import SensorParameters

__all__ = ["NoiseEvents"]

_FASTEST_HZ = 1e9
_LOG_STEP = 0.1  # between nodes of the table, ln f
_THRESHOLDS = 33
_NEVER = -80.0  # ln of a rate of nothing
_WINDOW_SLOTS = 16  # fewer: more calls; more: more seconds that every step looks through

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]


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


def _tables(p: SensorParameters, thresholds: _Floats) -> tuple[_Floats, _Floats, _Floats]:
    """Return the primaries' log rate over (thresholds, ln f), the share of seconds and tau in ns over ln f."""
    if math.isinf(p.corner_hz_at_reference):
        f_hz = np.full(2, np.inf)
    else:
        lowest, highest = math.log(p.corner_min_hz), math.log(min(p.corner_max_hz, _FASTEST_HZ))
        f_hz = np.exp(lowest + _LOG_STEP * np.arange(max(2, math.ceil((highest - lowest) / _LOG_STEP) + 2)))
    bandwidth = bandwidth_hz(p, f_hz)
    tau_s = 1 / (2 * np.pi * bandwidth)
    refractory = p.refractory_us * 1e-6 / tau_s
    second_share = np.exp(-1.6 * refractory)
    on_hz = bandwidth * rate_over_bandwidth(thresholds[:, None] / rms(p, f_hz), refractory)
    with np.errstate(divide="ignore"):
        log_rate = np.maximum(np.log(2 * on_hz / (1 + second_share)), _NEVER)
    return log_rate, second_share, tau_s * 1e9


def _lights(p: SensorParameters, nodes: int) -> _Float32s:
    figures = p.dark_current_relative, p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _FASTEST_HZ)
    if math.isinf(p.corner_hz_at_reference):
        figures = p.dark_current_relative, 1.0, 1.0, 1.0
    return np.array([*figures, 1 / _LOG_STEP, nodes - 1.001], np.float32)


class _Model:
    """The constants, in the layout that the loops of `draws` use."""

    def __init__(self, p: SensorParameters, seed: int, thresholds: _Floats) -> None:
        live = np.isfinite(thresholds)
        lowest, highest = thresholds[live].min(), thresholds[live].max() * (1 + 1e-6)
        log_rate, second_share, tau_ns = _tables(p, np.linspace(lowest, highest, _THRESHOLDS))
        row = np.where(live, (thresholds - lowest) / (highest - lowest) * (_THRESHOLDS - 1), 0)
        row = np.minimum(row, _THRESHOLDS - 1.001)
        log_highest = log_rate.max(axis=1)
        weight = np.where(live, np.exp(np.interp(row, np.arange(_THRESHOLDS), log_highest)), 0)
        own, other = _aliases(weight)
        share = np.minimum(own * 2.0**32, 2.0**32 - 1).astype(np.uint64)
        self.alias = share << np.uint64(32) | other
        self.row, self.log_highest = row.astype(np.float32), log_highest.astype(np.float32)
        self.table = np.vstack([log_rate, second_share, tau_ns]).astype(np.float32)
        self.lights = _lights(p, tau_ns.size)
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
        expected = _WINDOW_SLOTS / self._model.mean_gap
        self._reserve_candidates(int(expected + 8 * math.sqrt(expected)) + 600)
        self._soon, self._later = np.empty((2, 0), np.int64), np.empty((2, 0), np.int64)
        self._keys = np.empty(0, np.uint64)
        self._state = np.zeros(len(State), np.int64)
        self._state[State.REFRACTORY_NS] = round(parameters.refractory_us * 1000)
        self._state[State.PIXEL_BITS] = self._pixel_bits
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns`; events that began before its slot are left out."""
        self._t_ns, self._slot = t_ns, t_ns // SLOT_NS
        self._window_ns = self._slot * SLOT_NS
        self._state[[State.FIRST, State.COUNT, State.SOON, State.LATER]] = 0

    def step(self, light: _Float32s, t_ns: int) -> Crossings:
        """Return the events from the last time up to, and without, `t_ns`, under `light`, (pixels,) float32."""
        return self.add_to(NO_CROSSINGS, light, t_ns)

    def add_to(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Return a step's `crossings` with the noise events up to, and without, `t_ns` among them."""
        if t_ns <= self._t_ns:
            return crossings
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

    def _reserve_candidates(self, candidates: int) -> None:
        self._candidates, self._chances = np.empty((3, candidates), np.int64), np.empty((2, candidates), np.float32)

    def _open_window(self) -> None:
        """Draw the candidates of the next window, and reserve space for all events that may follow from them."""
        m, state = self._model, self._state
        slots = self._slot, _WINDOW_SLOTS, m.root, m.mean_gap
        while (n := draw_window(slots, m.alias, m.row, m.log_highest, self._candidates, self._chances)) < 0:
            self._reserve_candidates(2 * self._candidates.shape[1])
        self._slot += _WINDOW_SLOTS
        self._window_ns = self._slot * SLOT_NS
        needed = int(state[State.SOON] + state[State.LATER]) + n + 1
        self._soon = _reserve(self._soon, needed)
        self._later = _reserve(self._later, needed)
        if self._keys.size < 2 * needed:
            self._keys = np.empty(4 * needed, np.uint64)
        state[State.FIRST], state[State.COUNT], state[State.WINDOW_NS] = 0, n, self._window_ns
        sort_in(self._soon, self._later, state)

    def _advance(self, crossings: Crossings, light: _Float32s, t_ns: int) -> Crossings:
        """Move on within the window, and merge its events with the crossings."""
        t0_ns, self._t_ns = self._t_ns, t_ns
        m, state, bits = self._model, self._state, self._pixel_bits
        state[State.T0_NS], state[State.T1_NS] = t0_ns, t_ns
        drawn, seconds = (self._candidates, self._chances), (self._soon, self._later)
        found = fire(light, drawn, (m.table, m.lights), seconds, self._keys, state)
        if not found:
            return crossings
        keys = self._keys[:found]
        keys.sort()
        n = found + len(crossings)
        out = np.empty(n, np.int64), np.empty(n, np.uint32), np.empty(n, np.bool_)
        insert(keys, t0_ns, bits, (crossings.t_ns, crossings.pixel, crossings.on), out)
        return Crossings(*out, crossings.lost_in_pixel)


def _reserve(pending: npt.NDArray[np.int64], needed: int) -> npt.NDArray[np.int64]:
    """Return `pending`, (2, n), with at least `needed` columns."""
    n = pending.shape[1]
    return pending if needed <= n else np.concatenate([pending, np.empty((2, 2 * needed - n), np.int64)], axis=1)
