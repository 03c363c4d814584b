"""Pixels in still light whose noise is followed in steps of a two-hundredth of its time constant: a reference.

The noise x has unit variance and time constant; its steps are exact. A passage hidden between two steps has the
probability of a Brownian bridge. Nothing is shared with the emulator.
"""

import math

import numba

STEP = 0.005


@numba.njit
def passages(on, off, refractory, seconds, pixels, random):
    """Events of `pixels` pixels in `seconds` time constants, after as many to settle: pixel, time, 1 for ON."""
    decay, again = math.exp(-STEP), math.exp(-refractory)
    kick, blind = math.sqrt(1 - decay**2), math.sqrt(1 - again**2)
    found = [(0, 0.0, 0)]
    for pixel in range(pixels):
        x = random.normal()
        level, t = x, -seconds
        while t < seconds:
            y = x * decay + kick * random.normal()
            t += STEP
            up, down, event = level + on, level - off, -1
            if y >= up or (y > down and random.random() < math.exp(-(up - x) * (up - y) / STEP)):
                event = 1
            elif y <= down or random.random() < math.exp(-(x - down) * (y - down) / STEP):
                event = 0
            if event >= 0:
                if t >= 0:
                    found.append((pixel, t, event))
                y = (up if event else down) * again + blind * random.normal()
                level, t = y, t + refractory
            x = y
    return found[1:]
