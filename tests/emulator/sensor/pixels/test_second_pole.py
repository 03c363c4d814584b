"""Behind a second pole: the same events whatever the step, also where the first filter settles within a part of it."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import BLOCK, Field
from emulator.sensor.presets import PRESETS, SensorParameters
from laboratory.accuracy.harness import SEED, Case, Method, events, truth
from laboratory.accuracy.scenes import Flash, SineGrating
from laboratory.accuracy.scores import compare

OURS = Method("hermite", PixelArray, rate=True)
POLES_HZ = 100.0, 286.0, 1000.0
MS, US = 1_000_000, 1000


def sensor(width, **changes):
    return SensorParameters(
        width=width, height=1, dark_current_relative=1e-4, corner_hz_at_reference=300.0, corner_min_hz=1.0,
        corner_max_hz=3000.0, **{"threshold_on": 0.2, "threshold_off": 0.2, "mismatch": 0.03, **changes},
    )  # fmt: skip


def counts_after_a_jump(step_ns, jump_ns, contrast):
    """Events of 64 x 48 pixels of which the light jumps by `contrast` within `jump_ns`, and then stands still."""
    p = dataclasses.replace(PRESETS["davis346"], width=64, height=48, leak_hz=0.0, source_follower_hz=286.0)
    array = PixelArray(p, SEED)
    light = np.ones((48, 64), np.float32)
    array.reset(LightFrame(0, light))
    t_ns = 5 * MS
    n = len(array.step(LightFrame(t_ns, light)).t_ns)
    t_ns += jump_ns
    n += len(array.step(LightFrame(t_ns, light * np.float32(contrast))).t_ns)
    while t_ns < 40 * MS:
        t_ns += step_ns
        n += len(array.step(LightFrame(t_ns, light * np.float32(contrast))).t_ns)
    return n


@pytest.mark.sampled
@pytest.mark.parametrize("jump_ns", [10, 100 * US])
@pytest.mark.parametrize("contrast", [1.1, 1 / 1.1, 1.4])
def test_after_a_jump_the_step_does_not_matter(jump_ns, contrast):
    right = counts_after_a_jump(10 * US, jump_ns, contrast)
    for step_ns in (100 * US, 300 * US, MS, 5 * MS, 12 * MS):
        assert counts_after_a_jump(step_ns, jump_ns, contrast) == pytest.approx(right, rel=0.01)


@pytest.mark.sampled
@pytest.mark.parametrize("hz", POLES_HZ)
@pytest.mark.parametrize("step_s", [1e-3, 5e-3])
@pytest.mark.parametrize("refractory_us", [0.0, 2500.0])
@pytest.mark.parametrize("corner_hz", [300.0, 3000.0])
def test_a_flash_is_that_of_the_truth(hz, step_s, refractory_us, corner_hz):
    """At the middle of a step of either length, which is where it is put."""
    scene = Flash(pixels=60, first_s=0.0225, last_s=0.0225, bright=8.0)
    p = dataclasses.replace(
        sensor(60, source_follower_hz=hz, refractory_us=refractory_us), corner_hz_at_reference=corner_hz
    )
    case = Case("flash", scene, p, duration_s=0.06)
    scores = compare(events(OURS, case, step_s)[0], truth(case))
    assert scores.true_events >= 60
    assert scores.right >= 0.98
    assert scores.t95_us < 10


@pytest.mark.parametrize("hz", POLES_HZ)
@pytest.mark.parametrize(("step_s", "t95_us"), [(1e-3, 1.0), (5e-3, 90.0)])
@pytest.mark.parametrize("corner_hz", [200.0, 3000.0])
def test_a_sine_is_that_of_the_truth(hz, step_s, t95_us, corner_hz):
    p = dataclasses.replace(sensor(60, source_follower_hz=hz), corner_hz_at_reference=corner_hz)
    case = Case("sine", SineGrating(pixels=60), p, duration_s=0.2)
    scores = compare(events(OURS, case, step_s)[0], truth(case))
    assert scores.right >= (0.98 if step_s < 2e-3 else 0.85)
    assert scores.t95_us < t95_us


def integrated(light, rate, h, start, rates):
    """w after a step of h s, by Runge-Kutta; log light the cubic, the filter's rate in step with it.

    In 200 steps, or as many as make each no longer than 0.4 of the shorter time constant: right to 1e-9.
    """
    u0, u1 = np.log(light)
    a0, a1 = h * rate[0] / light[0], h * rate[1] / light[1]
    first, second = rates

    def slopes(z, y):
        u = u0 + z * (a0 + z * (3 * (u1 - u0) - 2 * a0 - a1 + z * (a0 + a1 - 2 * (u1 - u0))))
        return h * np.array([first * np.exp(u) * (u - y[0]), second * (y[0] - y[1])])

    y = np.array(start)
    n = 200 + round(2.5 * h * max(first * np.exp(max(u0.max(), u1.max())), second))
    for k in range(n):
        z, dz = k / n, 1 / n
        a = slopes(z, y)
        b = slopes(z + dz / 2, y + dz / 2 * a)
        c = slopes(z + dz / 2, y + dz / 2 * b)
        y = y + dz / 6 * (a + 2 * b + 2 * c + slopes(z + dz, y + dz * c))
    return y[1]


@pytest.mark.parametrize("tau_in_step", [0.05, 0.5, 0.99, 1.01, 2.0, 6.0, 20.0, 99.0, 101.0, 400.0])
@pytest.mark.parametrize("ratio", [0.02, 0.3, 1.0, 3.0])
def test_a_quiet_step_from_far_away_ends_where_the_equation_does(tau_in_step, ratio):
    """Up to 0.3 behind in both filters, with light that changes by up to 0.2; within 1 % of a threshold of 0.2."""
    h, n = 1e-3, BLOCK
    first = tau_in_step / h
    p = sensor(n, threshold_on=8.0, threshold_off=8.0, mismatch=0.0, source_follower_hz=ratio * first / 2 / np.pi)
    p = dataclasses.replace(
        p, dark_current_relative=1e-7, corner_hz_at_reference=first / 2 / np.pi, corner_min_hz=1e-3, corner_max_hz=1e9
    )
    rng = np.random.default_rng(5)
    d, bend, v, w = rng.uniform(-0.2, 0.2, (4, n)) * np.array([[1], [0.5], [1.5], [1.5]])
    light = np.array([np.ones(n), np.exp(d)]).astype(np.float32)
    rate = np.array([(d + bend) / h, (d - bend) / h * light[1]]).astype(np.float32)
    array = PixelArray(p, SEED)
    array.reset(LightFrame(0, light[:1], rate[:1]))
    fields = array.state.fields[0]
    fields[Field.FILTERED], fields[Field.SECOND], fields[Field.REFERENCE] = v, w, 0
    crossings = array.step(LightFrame(round(h * 1e9), light[1:], rate[1:]))
    there = array.state.fields[0, Field.SECOND]
    true = integrated(*(x.astype(np.float64) for x in (light, rate)), h, (v, w), (first, ratio * first))
    assert len(crossings.t_ns) == 0
    assert np.abs(there - true).max() < 2e-3
