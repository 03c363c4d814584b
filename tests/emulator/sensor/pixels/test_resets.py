"""Errors of a reset, and delays of comparators, against closed forms on ramps of log light."""

import dataclasses

import numpy as np
import pytest
from scipy.integrate import quad
from scipy.optimize import brentq

from emulator.light import LightFrame, Region
from emulator.sensor.numerics.compiled import cached_entry
from emulator.sensor.numerics.keyed import Purpose, normal
from emulator.sensor.parameters import ComparatorParameters, NoiseParameters, ResetParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.event_time import LONGEST_S, delay_s
from emulator.sensor.pixels.method import Capabilities
from emulator.sensor.pixels.state import StepConstants
from emulator.sensor.presets import SensorParameters

MS = 1_000_000
SLOPE = 40.0  # ln units a second
THETA = 0.25


def sensor(width=60, height=1, **changes):
    plain = SensorParameters(
        width=width,
        height=height,
        threshold_on=THETA,
        threshold_off=THETA,
        mismatch=0.0,
        leak_hz=0.0,
        leak_spread=0.0,
        dark_current_relative=1e-9,
        corner_hz_at_reference=np.inf,
        corner_max_hz=np.inf,
        random_start=False,
    )
    return dataclasses.replace(plain, **changes)


def ramp(p, slope, step_ns=MS, end_ns=100 * MS, seed=1, *, with_rate=False):
    """Times, ns, of all events of each pixel on a straight line in log light, and the array."""
    array, events = PixelArray(p, seed), []
    shape = p.height, p.width

    def frame(t_ns):
        light = np.full(shape, np.exp(slope * t_ns * 1e-9), np.float32)
        return LightFrame(t_ns, light, light * np.float32(slope) if with_rate else None)

    array.reset(frame(0))
    for t_ns in range(step_ns, end_ns + 1, step_ns):
        c = array.step(frame(t_ns))
        assert np.all((c.t_ns >= t_ns - step_ns) & (c.t_ns <= t_ns))
        assert np.all(np.diff(c.t_ns) >= 0)
        assert np.all(c.on == (slope > 0))
        events.append(np.stack([c.pixel.astype(np.int64), c.t_ns.copy()], axis=1))
    rows = np.concatenate(events)
    return [rows[rows[:, 0] == k, 1] for k in range(p.width * p.height)], array


@pytest.mark.parametrize("refractory_us", [0.0, 50.0])
@pytest.mark.parametrize("slope", [SLOPE, -SLOPE])
@pytest.mark.parametrize("step_ns", [MS, 20 * MS])
def test_an_offset_lengthens_the_way_to_on_and_shortens_that_to_off(refractory_us, slope, step_ns):
    """First event after THETA / slope, every other one THETA + offset (ON) or THETA - offset (OFF) later."""
    offset = 0.05
    p = sensor(refractory_us=refractory_us, reset=ResetParameters(offset=offset))
    times, _ = ramp(p, slope, step_ns)
    way = THETA + offset if slope > 0 else THETA - offset
    every_ns = way / SLOPE * 1e9 + refractory_us * 1000
    expected = THETA / SLOPE * 1e9 + np.arange(100) * every_ns
    expected = expected[expected < 100 * MS - 2000]
    assert len(expected) > 10
    for found in times:
        assert np.abs(found[: len(expected)] - expected).max() < 2000  # float32 of the light's logarithm


def test_noise_of_resets_is_that_of_its_key():
    """Way number k from reset k is THETA plus the deviation times the keyed number k of the pixel."""
    sigma, seed = 0.02, 7
    times, _ = ramp(sensor(reset=ResetParameters(noise=sigma)), SLOPE, seed=seed)
    for pixel, found in enumerate(times):
        ways = THETA + sigma * normal(seed, Purpose.RESET_NOISE, pixel, np.arange(len(found) - 1))
        expected = (THETA + np.concatenate([[0], np.cumsum(ways)])) / SLOPE * 1e9
        assert np.abs(found - expected).max() < 5000
    assert min(map(len, times)) >= 12


def test_noise_of_resets_varies_from_one_to_the_next_and_from_pixel_to_pixel():
    times, _ = ramp(sensor(width=300, reset=ResetParameters(noise=0.02)), SLOPE)
    ways = np.array([np.diff(found[:12]) for found in times]) * 1e-9 * SLOPE
    assert ways.mean() == pytest.approx(THETA, abs=4 * 0.02 / np.sqrt(ways.size))
    assert ways.std() == pytest.approx(0.02, rel=0.06)
    assert abs(np.corrcoef(ways[:, :-1].reshape(-1), ways[:, 1:].reshape(-1))[0, 1]) < 0.08


FULL = ResetParameters(offset=0.02, noise=0.02)


@pytest.mark.parametrize("refractory_us", [0.0, 300.0])
def test_resets_do_not_depend_on_the_step(refractory_us):
    p = sensor(refractory_us=refractory_us, reset=FULL)
    fine, coarse = (ramp(p, SLOPE, step_ns, with_rate=True)[0] for step_ns in (MS // 2, 25 * MS))
    for a, b in zip(fine, coarse, strict=True):
        n = min(len(a), len(b))
        assert abs(len(a) - len(b)) <= 1
        assert n > 5
        assert np.abs(a[:n] - b[:n]).max() < 5000


def flicker(p, t_ns):
    """Light that turns within steps of 10 ms, different in each pixel, with its rate."""
    k = np.arange(p.width * p.height).reshape(p.height, p.width)
    phase = 2 * np.pi * 30 * t_ns * 1e-9 + 0.05 * k
    light = np.exp(1.5 * np.sin(phase))
    rate = light * 1.5 * np.cos(phase) * 2 * np.pi * 30
    return light.astype(np.float32), rate.astype(np.float32)


def flickering(p, step_ns, *, refined=False, awake=False):
    array, out = PixelArray(p, 3), []

    def at(t_ns, pixels):
        light, rate = flicker(p, t_ns)
        return light.reshape(-1)[pixels], rate.reshape(-1)[pixels]

    array.reset(LightFrame(0, *flicker(p, 0)))
    for t_ns in range(step_ns, 60 * MS + 1, step_ns):
        if awake:
            array.wake()
        c = array.step(LightFrame(t_ns, *flicker(p, t_ns), at if refined else None))
        out.append(np.stack([c.pixel.astype(np.int64), c.t_ns.copy(), c.on.astype(np.int64)], axis=1))
    rows = np.concatenate(out)
    return rows[np.lexsort([rows[:, 1], rows[:, 0]])], array


def test_refined_pixels_keep_their_streams():
    """Pixels that are solved in a subset, under other numbers, have the resets of fine steps."""
    p = sensor(width=700, reset=ResetParameters(noise=0.03))
    fine, _ = flickering(p, MS // 10)
    refined, array = flickering(p, 5 * MS, refined=True)
    assert array.refined > 1000
    same = 0
    for pixel in range(700):
        a, b = fine[fine[:, 0] == pixel], refined[refined[:, 0] == pixel]
        same += len(a) == len(b) and np.array_equal(a[:, 2], b[:, 2]) and np.abs(a[:, 1] - b[:, 1]).max() < 300_000
    assert same > 0.9 * 700


def test_a_kick_resets_as_a_crossing_does():
    p = sensor(reset=ResetParameters(offset=0.04))
    _, array = ramp(p, SLOPE, end_ns=3 * MS)
    levels, pixel = array.levels(), np.arange(5)
    before = levels.of(pixel)
    levels.fire(pixel)
    assert np.allclose(levels.of(pixel), before - THETA - 0.04, atol=1e-6)


def test_still_pixels_are_skipped_with_the_same_events():
    p = sensor(width=2000, leak_hz=20.0, leak_spread=0.3, random_start=True, reset=FULL, refractory_us=50.0)
    found = []
    for changed in (None, Region(0, 0, 0, 0)):
        array, keys = PixelArray(p, 3), []
        light = np.ones((1, 2000), np.float32)
        array.reset(LightFrame(0, light))
        for t_ns in range(MS, 200 * MS, MS):
            c = array.step(LightFrame(t_ns, light, changed=changed))
            keys.append(np.stack([c.t_ns.copy(), c.pixel.astype(np.int64)], axis=1))
            if changed is None:
                array.wake()
        found.append(np.concatenate(keys))
    assert len(found[0]) > 5000
    assert np.array_equal(*found)


@cached_entry
def _delay(slope, on, c):
    return delay_s(slope, on, c)


def constants(on_us, off_us, contrast_per_e=0.0714):
    f, zero = np.float32, np.float32(0)
    return StepConstants(
        *(f(1e-3), f(1), f(1), f(1), zero, zero, f(1e-3), zero, f(1e-3), zero),
        h_ns=MS,
        t0_ns=0,
        refractory_ns=0,
        pixel_bits=10,
        chord=False,
        unseen_share=f(0.5),
        refine=False,
        large=False,
        on_delay=on_us * 1e-6,
        off_delay=off_us * 1e-6,
        contrast_per_e=contrast_per_e,
    )


@pytest.mark.parametrize("tau_us", [0.03, 5.0, 53.0, 2000.0])
@pytest.mark.parametrize("slope", [0.01, 1.0, 40.0, 3000.0])
def test_the_delay_is_that_of_the_currents(tau_us, slope):
    """The charge of the output node, by quadrature of the current, over time."""
    per_e, tau_s = 0.0714, tau_us * 1e-6

    def charged(t_s, on):
        current = (lambda t: np.expm1(slope * t / per_e)) if on else (lambda t: -np.expm1(-slope * t / per_e))
        return quad(current, 0, t_s, epsabs=0, epsrel=1e-11)[0] - tau_s

    for on in (True, False):
        longest = min(LONGEST_S, np.sqrt(2 * tau_s * per_e / slope) * 3 + 2 * tau_s)
        expected = brentq(charged, 1e-12, longest, args=(on,), xtol=1e-13) if charged(longest, on) > 0 else LONGEST_S
        found = _delay(slope, on, constants(tau_us, tau_us, per_e))
        assert found == pytest.approx(expected, rel=1e-6)


def test_a_level_that_hardly_moves_has_the_longest_delay_and_no_comparator_none():
    assert _delay(0.0, True, constants(1.0, 1.0)) == LONGEST_S
    assert _delay(1e-9, False, constants(10.0, 1e4)) == LONGEST_S
    assert _delay(5.0, True, constants(0.0, 50.0)) == 0


@pytest.mark.parametrize("slope", [SLOPE, -SLOPE])
@pytest.mark.parametrize("step_ns", [MS // 2, 20 * MS])
@pytest.mark.parametrize("refractory_us", [0.0, 200.0])
def test_events_of_a_ramp_come_late_by_the_delay_and_start_anew_there(slope, step_ns, refractory_us):
    """Each interval is THETA / slope, the delay of its polarity, and the refractory period."""
    p = sensor(refractory_us=refractory_us, comparator=ComparatorParameters(on_us=2.0, off_us=800.0))
    times, _ = ramp(p, slope, step_ns)
    late_ns = _delay(SLOPE, slope > 0, constants(2.0, 800.0)) * 1e9
    assert late_ns > (50_000 if slope > 0 else 1_000_000)  # the OFF ones reach into later steps
    every_ns = THETA / SLOPE * 1e9 + late_ns + refractory_us * 1000
    expected = THETA / SLOPE * 1e9 + late_ns + np.arange(60) * every_ns
    expected = expected[expected < 100 * MS - 5000]
    assert len(expected) > 8
    for found in times:
        assert np.abs(found[: len(expected)] - expected).max() < 4000


def test_delayed_events_do_not_depend_on_the_step():
    """References that are read anew are as good as the curve of a step: 3.7 us at 0.5 ms with a refractory period."""
    p = sensor(width=400, corner_hz_at_reference=300.0, corner_max_hz=300.0, corner_min_hz=3.0)
    p = dataclasses.replace(p, comparator=ComparatorParameters(on_us=1.0, off_us=300.0))
    fine, coarse = (flickering(p, step)[0] for step in (MS // 10, MS // 2))
    off_ns, same = [], 0
    for pixel in range(400):
        a, b = fine[fine[:, 0] == pixel], coarse[coarse[:, 0] == pixel]
        n = min(len(a), len(b))
        if abs(len(a) - len(b)) <= 1 and np.array_equal(a[:n, 2], b[:n, 2]):
            same += 1
            off_ns.append(np.abs(a[:n, 1] - b[:n, 1]))
    assert same >= 0.98 * 400
    assert np.quantile(np.concatenate(off_ns), 0.95) < 4000


def test_other_methods_refuse_what_they_do_not_have():
    for changes in ({"reset": FULL}, {"comparator": ComparatorParameters(off_us=10.0)}):
        with pytest.raises(ValueError, match="comparator"):
            Capabilities().check(sensor(**changes))
    Capabilities(has_comparator=True).check(sensor(reset=FULL))


def test_a_reset_that_fires_by_itself_is_refused():
    with pytest.raises(ValueError, match=r"reset\.offset"):
        sensor(reset=ResetParameters(offset=0.1, noise=0.02))
    with pytest.raises(ValueError, match="off_us"):
        ComparatorParameters(off_us=-1.0)
    with pytest.raises(ValueError, match="noise"):
        ResetParameters(noise=-0.1)
    assert sensor(noise=NoiseParameters()).reset == ResetParameters()
