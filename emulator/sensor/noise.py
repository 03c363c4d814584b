"""Noise events as a point process: drawn by their rate, at a cost that follows their number.

An excursion of the noise over a threshold and the way back are a pair of events of opposite polarity. So there are
primaries, ON or OFF by equal chance, and each has a second event with probability s, after 0.8 tau and an exponential
time of mean 1.4 tau (but no sooner than the refractory period lets it). The primaries' rate is 2 R / (1 + s), R the ON
rate of `noise_law`, so that ON and OFF come to R each. Where the refractory period is longer than tau the level is
read anew on the way back, and pairs dissolve: s = e^(-1.6 t_ref / tau), which is within 0.1 of a simulated pixel.

All that is random is keyed by a slot of 1024 us of stream time, never by the step. The primaries of a slot:

    gaps       exponential, of the total rate W of all pixels, W_p being the highest rate of a pixel in any light
    pixel      by a table of aliases (Walker 1977) in proportion to W_p
    thinning   kept with probability rate / W_p, the rate being that in the light of the step's last picture

An array of still light thus gives the same noise, bit for bit, whatever the steps. Left out: the pixel's level stays, a
noise event does not make its pixel blind, and the events of a moving picture are not shifted (noise brings them forward
by up to two rms over the contrast rate, before anything is known of them). This is enough while pairs do not overlap,
a >= 3.5 (4.5 with short refractory periods), and the picture moves by more than 0.3 rms in a time constant; else use
the grid grade.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.compiled import kernel, kernel_that_allocates, vector_kernel
from emulator.sensor.elementary import natural_log
from emulator.sensor.kept import kept_entry
from emulator.sensor.keyed import Purpose, root_of
from emulator.sensor.keyed_kernels import high, low, stream, unit, word
from emulator.sensor.noise_law import bandwidth_hz, rate_over_bandwidth, rms
from emulator.sensor.presets import SensorParameters
from emulator.sensor.slots import SLOT_NS, Ahead, SlottedEvents, Window, give_out, roomy

__all__ = ["NoiseEvents"]

_FASTEST_HZ = 1e9
_LOG_STEP = 0.1  # between nodes of the table, ln f
_THRESHOLDS = 33
_NEVER = -80.0  # ln of a rate of nothing

_Float32s = npt.NDArray[np.float32]
_Floats = npt.NDArray[np.float64]
_LARGEST = np.finfo(np.float32).max
_OWN, _ROW, _HIGHEST = range(3)  # columns of figures
_BATCH = 256
_ZERO, _UNITY, _HALF, _NAN = (np.float32(x) for x in (0, 1, 0.5, np.nan))
_NODES_A_FOLD = np.float32(1 / _LOG_STEP)
_ONE = np.uint64(1)
_SECONDS = 1 << 40  # first index of the numbers that seconds are drawn from


class _Lights(NamedTuple):
    """How light becomes a place among the nodes: dark current, corner frequencies in Hz, the last place."""

    dark: np.float32
    hz_at_reference: np.float32
    hz_min: np.float32
    hz_max: np.float32
    last: np.float32


class _Model(NamedTuple):
    """All that does not change: rates over (threshold, ln f), what a candidate needs of its pixel, and numbers."""

    log_rate: _Float32s  # (thresholds, nodes), ln of the primaries' rate in Hz
    second_share: _Float32s  # (nodes,), s
    tau_ns: _Float32s  # (nodes,)
    figures: _Float32s  # (pixels, 4): probability of the pixel itself, row of log_rate, ln W_p, 0
    alias: npt.NDArray[np.uint32]  # (pixels,)
    root: np.uint64
    mean_gap: float  # between candidates, as a share of a slot
    refractory_ns: float
    lights: _Lights


class _Draws(NamedTuple):
    """A slot, its stream, and how many of its candidates have been drawn."""

    slot: int
    base: np.uint64
    first: int


class _Candidates(NamedTuple):
    """A batch of primaries: time as a share of the slot, pixel, node, log of the rate; and which of them are kept."""

    t: _Floats
    pixel: npt.NDArray[np.uint64]
    node: _Float32s
    surplus: _Float32s
    kept: npt.NDArray[np.int64]


@vector_kernel
def _find_nodes(some: _Candidates, n: int, figures: _Lights) -> None:
    """Turn the light of n candidates into where it lies among the nodes; light that is not finite into NaN."""
    dark, at_reference, lowest, highest, last = figures
    for k in range(n):
        light = some.node[k]
        lit = light if light > _ZERO else _ZERO
        hz = min(max(at_reference * (lit + dark), lowest), highest)
        place = min(natural_log(hz / lowest) * _NODES_A_FOLD, last)
        some.node[k] = max(place, _ZERO) if abs(light) <= _LARGEST else _NAN


@kernel
def _propose(d: _Draws, t: float, m: _Model, some: _Candidates) -> tuple[int, float]:
    """Draw times and pixels of the slot's next candidates; return how many lie in the slot, and the last time."""
    for k in range(_BATCH):
        index = 3 * (d.first + k)
        t -= m.mean_gap * np.float64(natural_log(np.float32(unit(high(word(d.base, index))))))
        bits = word(d.base, index + 1)
        pixel = np.uint64((high(bits) * np.uint64(m.alias.shape[0])) >> np.uint64(32))
        other = np.uint64(m.alias[pixel])
        some.pixel[k] = pixel if unit(low(bits)) < m.figures[pixel, _OWN] else other
        some.t[k] = t
        if t >= 1:
            return k, t
    return _BATCH, t


@kernel
def _find_rates(some: _Candidates, n: int, m: _Model) -> None:
    """Write ln of each candidate's rate over its pixel's highest into `some.surplus`; NaN where light is unreadable.

    Straight between the table's nodes in both directions.
    """
    for k in range(n):
        pixel, node = some.pixel[k], some.node[k]
        row, place = m.figures[pixel, _ROW], node if node == node else _ZERO
        i, j = np.uint64(np.int64(row)), np.uint64(np.int64(place))
        y, x = row - np.float32(i), node - np.float32(j)
        upper = m.log_rate[i, j] * (_UNITY - x) + m.log_rate[i, j + _ONE] * x
        lower = m.log_rate[i + _ONE, j] * (_UNITY - x) + m.log_rate[i + _ONE, j + _ONE] * x
        some.surplus[k] = upper * (_UNITY - y) + lower * y - m.figures[pixel, _HIGHEST]


@kernel
def _choose(d: _Draws, some: _Candidates, n: int) -> int:
    """List the candidates that fire in `some.kept`, return how many."""
    kept = 0
    for k in range(n):
        some.kept[kept] = k
        kept += natural_log(np.float32(unit(high(word(d.base, 3 * (d.first + k) + 2))))) < some.surplus[k]
    return kept


@kernel
def _thin(d: _Draws, light: _Float32s, m: _Model, some: _Candidates, n: int) -> int:
    """List those of n candidates that fire; return how many. Four short loops, because one takes four times as long."""
    for k in range(n):
        some.node[k] = light[some.pixel[k]]
    _find_nodes(some, n, m.lights)
    _find_rates(some, n, m)
    return int(_choose(d, some, n))


@kernel
def _fire(d: _Draws, m: _Model, some: _Candidates, kept: int, ahead: Ahead, n: int) -> int:
    """Add those that fire, and the seconds of their pairs, to `ahead` from n on; return the new n."""
    for one in range(kept):
        k = some.kept[one]
        index = 3 * (d.first + k)
        key = np.uint64(some.pixel[k]) << _ONE | (word(d.base, index) & _ONE)
        t_ns = d.slot * SLOT_NS + np.int64(some.t[k] * SLOT_NS)
        ahead.t_ns[n], ahead.key[n] = t_ns, key
        nearest = np.int64(some.node[k] + _HALF)
        pair = word(d.base, index + _SECONDS)
        wait = 0.8 - 1.4 * np.float64(natural_log(np.float32(unit(high(pair)))))
        ahead.t_ns[n + 1] = t_ns + np.int64(max(wait * m.tau_ns[nearest], m.refractory_ns))
        ahead.key[n + 1] = key ^ _ONE
        n += 2 if unit(low(pair)) < m.second_share[nearest] else 1
    return n


@kernel_that_allocates
def _draw_slot(slot: int, light: _Float32s, m: _Model, some: _Candidates, ahead: Ahead, n: int) -> tuple[Ahead, int]:
    """Add the events that begin in a slot to `ahead` from n on."""
    base, first, t = stream(m.root, slot), 0, 0.0
    while t < 1:
        d = _Draws(slot, base, first)
        proposed, t = _propose(d, t, m, some)
        kept = _thin(d, light, m, some, proposed)
        ahead = roomy(ahead, n, 2 * kept)
        n = _fire(d, m, some, kept, ahead, n)
        first += proposed
    return ahead, n


@kept_entry
def _advance(
    window: Window,
    light: _Float32s,
    m: _Model,
    ahead: Ahead,
    n: int,
) -> tuple[Ahead, int, npt.NDArray[np.uint64]]:
    """Draw what is missing up to t1; return what lies ahead of it, and the packed events before it, unsorted."""
    some = _Candidates(
        np.empty(_BATCH),
        np.empty(_BATCH, np.uint64),
        np.empty(_BATCH, np.float32),
        np.empty(_BATCH, np.float32),
        np.empty(_BATCH + 1, np.int64),
    )
    for slot in range(window.slot, -(-window.t1_ns // SLOT_NS)):
        ahead, n = _draw_slot(slot, light, m, some, ahead, n)
    keys = np.empty(n + 1, np.uint64)
    found, kept = give_out(window, ahead, n, keys)
    return ahead, kept, keys[:found]


@kept_entry
def _aliases(weight: _Floats) -> tuple[_Floats, npt.NDArray[np.uint32]]:
    """Return, for each pixel, the probability to stay with it and the pixel to take else (Walker 1977, Vose 1991)."""
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


def _model(p: SensorParameters, seed: int, thresholds: _Floats) -> _Model:
    live = np.isfinite(thresholds)
    lowest, highest = thresholds[live].min(), thresholds[live].max() * (1 + 1e-6)
    nodes = np.linspace(lowest, highest, _THRESHOLDS)
    log_rate, second_share, tau_ns = _tables(p, nodes)
    row = np.where(live, (thresholds - lowest) / (highest - lowest) * (_THRESHOLDS - 1), 0)
    row = np.minimum(row, _THRESHOLDS - 1.001)
    log_highest = np.interp(row, np.arange(_THRESHOLDS), log_rate.max(axis=1))
    weight = np.where(live, np.exp(log_highest), 0)
    own, alias = _aliases(weight)
    lights = p.dark_current_relative, p.corner_hz_at_reference, p.corner_min_hz, min(p.corner_max_hz, _FASTEST_HZ)
    if math.isinf(p.corner_hz_at_reference):
        lights = p.dark_current_relative, 1.0, 1.0, 1.0
    return _Model(
        log_rate=log_rate.astype(np.float32),
        second_share=second_share.astype(np.float32),
        tau_ns=tau_ns.astype(np.float32),
        figures=np.stack([own, row, log_highest, np.zeros_like(own)], axis=1).astype(np.float32),
        alias=alias,
        root=root_of(seed, Purpose.NOISE_EVENTS),
        mean_gap=1 / (weight.sum() * SLOT_NS * 1e-9),
        refractory_ns=p.refractory_us * 1000,
        lights=_Lights(*(np.float32(number) for number in (*lights, tau_ns.size - 1.001))),
    )


class NoiseEvents(SlottedEvents):
    """The noise events of an array.

    Parameters
    ----------
    parameters : the sensor; `noise.rms` > 0.
    seed : keys all that is random.
    thresholds : (pixels,) float64, mean of each pixel's two thresholds, ln units; infinite for dead pixels.
    """

    def __init__(self, parameters: SensorParameters, seed: int, thresholds: _Floats) -> None:
        super().__init__(thresholds.size)
        self._model = _model(parameters, seed, thresholds)

    def _advance(
        self, window: Window, light: _Float32s, ahead: Ahead, known: int
    ) -> tuple[Ahead, int, npt.NDArray[np.uint64]]:
        result: tuple[Ahead, int, npt.NDArray[np.uint64]] = _advance(window, light, self._model, ahead, known)
        return result
