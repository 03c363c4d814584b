"""The quiet test of the pixel step: it rejects no pixel that fires."""

import numpy as np
import pytest

from emulator.sensor.numerics.compiled import cached_entry
from emulator.sensor.pixels import quiet_pass as kernels
from emulator.sensor.pixels.state import BEFORE_ROWS, BLOCK, StepConstants


@pytest.mark.system
@pytest.mark.parametrize("large", [False, True], ids=["one pole", "large signals"])
@pytest.mark.parametrize("touching", [False, True], ids=["anywhere", "touching"])
def test_the_quiet_test_rejects_no_step_that_fires(touching, large):
    """100 000 random steps along cubics in log light against RK4 with 200 sub-steps in float64.

    Slopes from -1 to 1 a step, turns, lags up to black against white, rates that meet their bounds inside, leak.
    `touching`: the thresholds lie 2e-6 inside the highest or lowest value of the step, so that bounds that are a
    little too narrow show.
    """
    blocks, rng = 100_000 // BLOCK, np.random.default_rng(11)
    n, h, since = blocks * BLOCK, 1e-3, 3.0
    u0 = rng.uniform(-4, 0, n)
    u1 = u0 + rng.uniform(-0.5, 0.5, n)
    a0, a1 = (np.where(rng.random(n) < 0.5, rng.uniform(-1, 1, n), u1 - u0) for _ in range(2))
    turns = rng.random(n) < 0.3  # from below the least rate, or above the most, over its bound and back
    u0[turns] = rng.choice([-2.5, -1.5], n)[turns] + rng.uniform(-0.1, 0.1, turns.sum())
    u1[turns], a1[turns] = u0[turns], -a0[turns]
    v0 = u0 + rng.normal(0, 1, n) * rng.choice([0.0, 0.3, 5.0], n, p=[0.4, 0.4, 0.2])
    at_reference = np.exp(rng.uniform(np.log(0.01), np.log(10), blocks)).repeat(BLOCK) / h / np.exp(-2)
    least, most = at_reference * np.exp(-2.5), at_reference * np.exp(-1.5)  # met inside a quarter of the steps
    leak = rng.uniform(0, 5, n)

    def rate(u):
        return np.clip(at_reference * np.exp(u), least, most)

    rising, falling = _extremes((u0, u1, a0, a1), v0, leak, rate, h, large)
    if touching:
        up, fires = rising > -falling, np.maximum(rising, -falling) > 1e-4
        start, on, off = (
            np.zeros(n),
            np.where(up, rising - 2e-6, rising + 1),
            np.where(up, 1 - falling, -falling - 2e-6),
        )
    else:
        on, off = rng.uniform(0.1, 0.3, n), rng.uniform(0.1, 0.3, n)
        start = rng.uniform(-1, 1, n) * np.where(rng.random(n) < 0.5, on, off) * 0.999
        fires = (start + rising >= on) | (start + falling <= -off)
    reference = v0 + leak * since - start
    unused = np.zeros_like(u0)
    fields = np.stack([u0, v0, rate(u0), a0 / h / rate(u0), reference, on, off, leak, unused, unused]).astype(
        np.float32
    )
    may_fire, light = np.zeros(n, np.uint8), (np.exp(u1) - 1e-3).astype(np.float32)
    slope = (np.exp(u1) * a1 / h).astype(np.float32)
    for block in range(blocks):
        here = slice(block * BLOCK, (block + 1) * BLOCK)
        lit = light[here], slope[here]
        may_fire[here] = _may_fire(fields[:, here], lit, at_reference[block * BLOCK], (h, since), large)
    assert fires.sum() > 20_000
    assert np.all(may_fire[fires] == 1)
    plain = (np.abs(u1 - u0 - (a0 + a1) / 2) < 0.04) & (np.abs(a0 - a1) < 0.4)  # others are may_fire for their light
    assert touching or np.mean(may_fire[~fires & plain]) < 0.25


def _extremes(light, v0, leak, rate, h, large, steps=200):
    """Highest and lowest rise of the filtered value, leak added, over a step along a cubic in log light.

    The large-signal law is the low-pass of e^-u, of which the output is -ln.
    """
    u0, u1, a0, a1 = light
    d = u1 - u0
    y, high, low = (np.ones_like(v0) if large else v0.copy()), np.zeros_like(v0), np.zeros_like(v0)
    dt = h / steps

    def slope(z, y):
        u = u0 + ((((a0 + a1 - 2 * d) * z + 3 * d - 2 * a0 - a1) * z + a0) * z)
        return rate(u) * ((np.exp(v0 - u) if large else u) - y)

    for k in range(steps):
        z, dz = k / steps, 1 / steps
        k1 = slope(z, y)
        k2 = slope(z + dz / 2, y + dt / 2 * k1)
        k3 = slope(z + dz / 2, y + dt / 2 * k2)
        y = y + dt / 6 * (k1 + 2 * k2 + 2 * k3 + slope(z + dz, y + dt * k3))
        risen = (-np.log(y) if large else y - v0) + leak * (k + 1) * dt
        high, low = np.maximum(high, risen), np.minimum(low, risen)
    return high, low


def _may_fire(fields, light_and_slope, at_reference, times_s, large):
    """What the quiet pass says of one block."""
    f, (h, since) = np.float32, times_s
    rates = f(at_reference), f(at_reference * np.exp(-2.5)), f(at_reference * np.exp(-1.5))
    extras = {"parasitic": f(0), "second": f(0), "refractory_ns": 0, "pixel_bits": 17, "chord": False}
    extras |= {"unseen_share": f(0.5), "refine": False, "large": large}
    times = {"h": f(h), "since_epoch_0": f(since), "since_epoch_1": f(since + h), "refractory": f(0)}
    c = StepConstants(f(1e-3), *rates, **times, h_ns=round(h * 1e9), t0_ns=0, **extras)
    s, before = fields.reshape(-1), np.empty(len(BEFORE_ROWS) * BLOCK, np.float32)
    may_fire = np.empty(BLOCK, np.uint8)
    _quiet_pass(*light_and_slope, s, before, may_fire, c)
    return may_fire


@cached_entry
def _quiet_pass(light, slope, s, before, may_fire, c):
    kernels.move_quietly(light, slope, s, before, may_fire, c)
