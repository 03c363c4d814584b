"""References that noise has left by the start of a stream, and the pixels' first certificates.

A sensor that has run for a while has references at which events are rare: those near a threshold have been left. Each
pixel's references are a Markov chain: it stays at one for an exponential time, whose mean follows from the hazard in
still light, and the next one is the noise at the end of the dead time, relative to the signal. The chain runs for the
time before the start, but no longer than some mean stays at the reference where events are rarest, in which it settles,
and than leak takes for half a threshold. A burst is shorter than any of that: its hazard is taken as that of noise that
has forgotten the reset.

Fast because an event is one look at the hazard and three random numbers, shared by threads.
"""

from __future__ import annotations

import math

import numpy as np

from emulator.sensor.noise.hazard import Distance, Hazard, Noise, hazard, noise_of, transition
from emulator.sensor.numerics.compiled import cached_entry, kernel
from emulator.sensor.numerics.keyed import high, low, normal_from, stream, unit, word
from emulator.sensor.pixels.passage import certify
from emulator.sensor.pixels.state import BLOCK, MEMORY, Field, Pixels, StepConstants, slot

_V, _L, _REF, _ON, _OFF, _LEAK, _W, _UNTIL = (
    int(f) * BLOCK
    for f in (
        Field.FILTERED, Field.RATE, Field.REFERENCE, Field.ON, Field.OFF, Field.LEAK, Field.SECOND, Field.UNTIL,
    )
)  # fmt: skip
_STAYS = 3.0  # longest mean stays of a reference that are run
_MOST_EVENTS = 64
_LONG_S = 1e6  # since the reset
_LEAST_LEAK = 1e-9  # ln units a second
_LEAST_HZ = 1e-6


@kernel
def _still(on: float, off: float, noise: Noise, pixels: Pixels) -> Hazard:
    """Return the hazard of a pixel in still light, at distances from its thresholds."""
    h: Hazard = hazard(_LONG_S, Distance(on, off, 0.0, 0.0), 0.0, 0.0, noise, pixels.tables)
    return h


@cached_entry
def settle(first: int, last: int, history_s: float, root: np.uint64, pixels: Pixels, c: StepConstants) -> None:  # noqa: PLR0913, PLR0917
    """Let noise act on pixels first to last - 1 before the end of a step in which nothing moved; certify them.

    Parameters
    ----------
    history_s : longest time for which it has acted.
    root : of the random numbers.
    """
    fields = pixels.fields
    dead_s = c.refractory_ns * 1e-9
    for pixel in range(first, last):
        at = slot(pixel)
        signal = np.float64(fields[at + _V])
        if not abs(signal) < np.inf:
            continue
        on, off = np.float64(fields[at + _ON]), np.float64(fields[at + _OFF])
        leak, rate = np.float64(fields[at + _LEAK]), np.float64(fields[at + _L])
        value = signal + leak * c.since_epoch_1
        noise = noise_of(rate, c.noise_pole, c.noise_rms * pixels.memory[pixel * MEMORY + 2])
        number = stream(root, np.int64(pixels.memory[pixel * MEMORY + 3]))
        rarest = _still((on + off) / 2, (on + off) / 2, noise, pixels)
        left_s = min(history_s, 0.5 * on / max(leak, _LEAST_LEAK), _STAYS / max(rarest.on + rarest.off, _LEAST_HZ))
        level = np.float64(fields[at + _REF]) - value + leak * left_s
        for k in range(_MOST_EVENTS):
            h = _still(on + level, off - level, noise, pixels)
            bits = word(number, 2 * k)
            stays_s = -math.log(unit(high(bits))) / max(h.on + h.off, 1e-30)
            if stays_s >= left_s:
                break
            left_s -= stays_s + dead_s
            level += on if unit(low(bits)) * (h.on + h.off) < h.on else -off
            normal = noise.sigma * normal_from(word(number, 2 * k + 1))
            if noise.ratio == 0.0:
                decay = math.exp(-noise.rate * dead_s)
                level = level * decay + normal * math.sqrt(1 - decay * decay)
            elif dead_s > 0:
                m = transition(dead_s, noise)
                level = level * m.p11 + normal * math.sqrt(m.v)
        fields[at + _REF] = np.float32(value + level - leak * max(left_s, 0.0))
        certify(pixels, pixel, value, rate, c)
