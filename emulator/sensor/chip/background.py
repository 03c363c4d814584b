"""Background activity as it was counted on a recording: events at a constant rate, some in pairs, some pixels hot.

Each pixel has a rate of its own, drawn once: log-normal around the mean, or that of a hot pixel. Primaries are drawn by
slots of stream time, their pixel in proportion to its rate; a primary is followed by an event of the other polarity
with a probability of its pixel, after an exponential time. Events do not depend on the light, and leave the pixel's
level alone.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.slots import SLOT_NS, Pending, SlottedEvents, Window, release, reserve
from emulator.sensor.numerics.cached import cached_entry
from emulator.sensor.numerics.compiled import kernel_that_allocates
from emulator.sensor.numerics.keyed import Purpose, normal, root_of, uniform
from emulator.sensor.numerics.keyed_kernels import high, low, stream, unit, word
from emulator.sensor.presets import SensorParameters

__all__ = ["BackgroundEvents", "primaries_hz"]

_ONE = np.uint64(1)

_Floats = npt.NDArray[np.float64]


class _Constants(NamedTuple):
    """The stream, the mean gap between primaries as a share of a slot, the share of OFF, and the mean wait in ns."""

    root: np.uint64
    mean_gap: float
    off_share: float
    wait_ns: float


def primaries_hz(p: SensorParameters, seed: int) -> tuple[_Floats, _Floats]:
    """Return each pixel's rate of primaries, Hz, and the probability that a second event follows."""
    b, pixel = p.background, np.arange(p.width * p.height)
    hz = b.hz * np.exp(b.spread * normal(seed, Purpose.BACKGROUND_RATE, pixel) - b.spread**2 / 2)
    hot = uniform(seed, Purpose.BACKGROUND_HOT, pixel) < b.hot_share
    pair = np.where(hot, b.hot_pair_share, b.pair_share)
    return np.where(hot, b.hot_hz, hz) / (1 + pair), pair


@kernel_that_allocates
def _draw_slot(
    slot: int, c: _Constants, below: _Floats, pair: _Floats, pending: Pending, n: int
) -> tuple[Pending, int]:
    """Add the events that begin in a slot to `pending` from n on; `below` are sums of rates up to each pixel."""
    base, t, k = stream(c.root, slot), 0.0, 0
    while True:
        gap, choice, rest = word(base, 3 * k), word(base, 3 * k + 1), word(base, 3 * k + 2)
        t -= c.mean_gap * math.log(unit(high(gap)))
        if t >= 1:
            return pending, n
        pixel = np.searchsorted(below, unit(high(choice)) * below[-1], side="right")
        on = np.uint64(unit(low(gap)) >= c.off_share)
        key, t_ns = np.uint64(pixel) << _ONE | on, slot * SLOT_NS + int(t * SLOT_NS)
        pending = reserve(pending, n, 2)
        pending.t_ns[n], pending.key[n] = t_ns, key
        n += 1
        if unit(low(choice)) < pair[pixel]:
            pending.t_ns[n] = t_ns + 1 + int(-c.wait_ns * math.log(unit(high(rest))))
            pending.key[n] = key ^ _ONE
            n += 1
        k += 1


@cached_entry
def _advance(
    window: Window, c: _Constants, below: _Floats, pair: _Floats, pending: Pending, n: int
) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
    """Draw the slots up to t1; return the events pending after t1, and the packed events before it, unsorted."""
    for slot in range(window.slot, -(-window.t1_ns // SLOT_NS)):
        pending, n = _draw_slot(slot, c, below, pair, pending, n)
    keys = np.empty(n + 1, np.uint64)
    found, remaining = release(window, pending, n, keys)
    return pending, remaining, keys[:found]


class BackgroundEvents(SlottedEvents):
    """The background activity of a chip.

    Parameters
    ----------
    parameters : SensorParameters
        The sensor, with a `background` rate.
    seed : int
        Keys all random numbers.
    dead : (n,) int64
        Pixels that raise no events.
    """

    def __init__(self, parameters: SensorParameters, seed: int, dead: npt.NDArray[np.int64]) -> None:
        p = parameters
        super().__init__(p.width * p.height)
        hz, self._pair = primaries_hz(p, seed)
        hz[dead] = 0
        self._below = np.cumsum(hz)
        total_hz = max(float(self._below[-1]), 1e-12)
        self._constants = _Constants(
            root=root_of(seed, Purpose.BACKGROUND),
            mean_gap=1 / (total_hz * SLOT_NS * 1e-9),
            off_share=p.background.off_share,
            wait_ns=p.background.pair_us * 1000,
        )

    def _advance(
        self, window: Window, light: npt.NDArray[np.float32], pending: Pending, known: int
    ) -> tuple[Pending, int, npt.NDArray[np.uint64]]:
        result: tuple[Pending, int, npt.NDArray[np.uint64]] = _advance(
            window, self._constants, self._below, self._pair, pending, known
        )
        return result
