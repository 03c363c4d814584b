"""Noise followed in time: exact laws of its events, the pixel without noise, and steps that do not matter.

Seeds are fixed; a comparison of means fails with a probability of 1e-4 where the law holds.
"""

import copy
import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

from emulator.light import LightFrame
from emulator.sensor.chip.defects import draw_defects
from emulator.sensor.parameters import (
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    TemperatureParameters,
)
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import joined
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.methods.grid import NoisyPixels, grid_ns

MS = 1_000_000
S = 1000 * MS
Z = stats.norm.isf(1e-4 / 2)
PLAIN = SensorParameters(
    width=8, height=5, threshold_on=0.2, threshold_off=0.2, mismatch=0.03, leak_hz=0.0, corner_hz_at_reference=300.0,
)  # fmt: skip


def noisy(a, p=PLAIN, **changes):
    """A sensor whose noise at light 1 is 1/a of a threshold; f and the fixed pole are both 300 Hz there."""
    return dataclasses.replace(p, noise=NoiseParameters(0.2 / a * 2**0.5, 300.0, "grid"), **changes)


def still(level=1.0, p=PLAIN):
    return np.full((p.height, p.width), level, np.float32)


def drifting(t_ns):
    y, x = np.mgrid[:5, :8]
    return np.exp(0.8 * np.sin(0.3 * x + 0.2 * y - 40e-9 * t_ns)).astype(np.float32)


def run(p, times, scene=lambda t: still(), seed=1, make=NoisyPixels):
    pixels = make(p, seed)
    pixels.reset(LightFrame(0, scene(0)))
    parts = [copy.deepcopy(pixels.step(LightFrame(t, scene(t)))) for t in times]
    return joined(parts), pixels


def at_rest(a, tau1_us, tau2_us, refractory_us, pixels=200):
    """A sensor in light that moves no pixel, thresholds of a (1 +- .02) deviations of the noise at the comparator."""
    f1, f2 = (1e6 / (2 * np.pi * tau) if tau else 0.0 for tau in (tau1_us, tau2_us))
    rms = 0.2 / a * ((tau1_us + tau2_us) / tau1_us) ** 0.5
    return dataclasses.replace(
        PLAIN, width=pixels, height=1, threshold_on=0.204, threshold_off=0.196, mismatch=0.0, corner_max_hz=f1,
        corner_hz_at_reference=f1, dark_current_relative=1e-9, refractory_us=refractory_us,
        noise=NoiseParameters(rms, f2, "grid"),
    )  # fmt: skip


def rate_and_order(p, seconds, delta_ns=0):
    """Events of a pixel and second after a time to settle, its standard error, and the share of opposite successors."""
    found, _ = run(p, [S, S + round(seconds * S)], lambda t: still(p=p), make=lambda *a: NoisyPixels(*a, delta_ns))
    kept = found.t_ns > S
    counts = np.bincount(found.pixel[kept], minlength=p.width) / seconds
    order = np.lexsort((found.t_ns[kept], found.pixel[kept]))
    pixel, on = found.pixel[kept][order], found.on[kept][order]
    same = pixel[1:] == pixel[:-1]
    return counts.mean(), counts.std() / p.width**0.5, (on[1:] != on[:-1])[same].mean()


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(
    ("a", "refractory", "law", "opposite"),
    [(1.6, 0.02, 0.62395, 0.7329), (2.0, 0.1, 0.34113, 0.8014), (2.0, 1.0, 0.24029, 0.6533),
     (3.0, 0.02, 0.08695, 0.9316)],
)  # fmt: skip
def test_one_pole_has_the_law_of_first_passages(a, refractory, law, opposite):
    """Rates by the time constant: the exact Markov chain of levels, solved in float64 (Siegert's first-passage law)."""
    rate, error, found_opposite = rate_and_order(at_rest(a, 1000.0, 0.0, 1000 * refractory), 3)
    assert abs(rate - 1000 * law) < Z * error + 0.003 * 1000 * law
    assert found_opposite == pytest.approx(opposite, abs=0.004)


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(
    ("a", "tau1_us", "tau2_us", "rate", "error", "opposite"),
    [(1.6, 487.0, 84.0, 575, 0.004, 0.765), (2.0, 53.0, 84.0, 1262, 0.005, 0.889), (3.0, 53.0, 84.0, 285, 0.014, 0.965),
     (2.0, 84.0, 84.0, 997, 0.006, 0.881), (2.0, 1900.0, 84.0, 122, 0.006, 0.836)],
)  # fmt: skip
def test_two_poles_have_the_rate_of_a_simulation_by_others(a, tau1_us, tau2_us, rate, error, opposite):
    """Rates and their errors of a program that shares no code: steps of a tenth, so its rates are .6 % low at most."""
    found, own_error, found_opposite = rate_and_order(at_rest(a, tau1_us, tau2_us, 20.0), 2)
    assert abs(found - rate) < Z * math.hypot(own_error, error * rate) + 0.006 * rate
    assert found_opposite == pytest.approx(opposite, abs=0.006)


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize("poles_us", [(487.0, 84.0), (487.0, 0.0)])
def test_half_the_step_gives_the_same_rates(poles_us):
    p = at_rest(2.0, *poles_us, 20.0)
    one, half = (rate_and_order(p, 2, grid_ns(p) // share) for share in (1, 2))
    assert abs(one[0] - half[0]) < Z * math.hypot(one[1], half[1])
    assert one[2] == pytest.approx(half[2], abs=0.006)


@pytest.mark.sampled
@pytest.mark.parametrize(("tau1_us", "tau2_us"), [(53.0, 84.0), (84.0, 84.0), (1900.0, 84.0)])
def test_two_poles_cross_a_level_at_rices_rate(tau1_us, tau2_us):
    """Shortly after the start, first passages are crossings; fewer than 3 % are of pixels that began beyond."""
    p = dataclasses.replace(at_rest(1.5, tau1_us, tau2_us, 1e6), width=1000, height=1000, random_start=False)
    slope = 1e6 / (tau1_us * tau2_us) ** 0.5
    found, pixels = run(p, [round(0.1e9 / slope)], lambda t: still(p=p))
    beyond = stats.norm.sf([1.5 * 1.02, 1.5 * 0.98]).sum() * 1e6
    assert np.count_nonzero(found.t_ns == 0) == pytest.approx(beyond, rel=0.011)
    crossings = slope / (2 * np.pi) * np.exp([-0.5 * (1.5 * k) ** 2 for k in (1.02, 0.98)]).sum()
    expected = crossings * pixels.settled_ns * 1e-9 * 1e6
    assert 0.97 * expected - Z * expected**0.5 < np.count_nonzero(found.t_ns) < expected + Z * expected**0.5


def test_the_rms_behind_the_receptor_stays_when_the_light_changes():
    """So that behind the fixed pole it rises as the light falls, to its stationary value after some time constants."""
    p = dataclasses.replace(at_rest(20.0, 53.0, 84.0, 0.0, 5000), corner_min_hz=1.0, threshold_on=50, threshold_off=50)
    pixels = NoisyPixels(p, 1)
    pixels.reset(LightFrame(0, still(1.0, p)))
    for t_ns, light in ((MS, 1.0), (5 * MS, 0.1), (8 * MS, 0.1)):
        pixels.step(LightFrame(t_ns, still(light, p)))
        tau1_us = 53.0 / light
        of_sum = np.cov(pixels._state.n1, pixels._state.n2)
        passed = tau1_us / (tau1_us + 84.0)
        assert of_sum == pytest.approx(np.array([[1, passed], [passed, passed]]), abs=Z * (2 / 5000) ** 0.5)


@pytest.mark.parametrize(
    "effects",
    [{}, {"source_follower_hz": 150.0}, {"parasitic_hz_at_reference": 20.0}, {"corner_hz_at_reference": math.inf}],
    ids=["one pole", "two poles", "parasitic leak", "no low-pass"],
)
def test_with_little_noise_it_is_the_pixel_itself(effects):
    p = noisy(1000, refractory_us=300.0, leak_hz=3.0, **effects)
    times = range(MS, 301 * MS, MS)
    found, _ = run(p, times, drifting)
    expected, _ = run(dataclasses.replace(p, noise=NoiseParameters()), times, drifting, make=PixelArray)
    n = len(found)
    assert abs(n - len(expected)) < 0.005 * n
    assert n > 900
    order, order_expected = (np.lexsort([e.t_ns, e.pixel]) for e in (found, expected))
    counts = [np.bincount(e.pixel, minlength=40) for e in (found, expected)]
    same = np.flatnonzero(counts[0] == counts[1])
    assert same.size >= 36
    a, b = np.isin(found.pixel[order], same), np.isin(expected.pixel[order_expected], same)
    assert np.array_equal(found.on[order][a], expected.on[order_expected][b])
    off_ns = np.abs(found.t_ns[order][a] - expected.t_ns[order_expected][b])
    assert np.median(off_ns) < 25_000  # the noise is worth some 10 000


@pytest.mark.sampled
@pytest.mark.parametrize("step_ns", [500_000, 5 * MS, 20 * MS, 333_333])
def test_steps_do_not_matter(step_ns):
    p = noisy(3, leak_hz=5.0, refractory_us=100.0)
    one, pixels = run(p, range(MS, 200 * MS + 1, MS))
    other, _ = run(p, [*range(step_ns, 200 * MS, step_ns), 200 * MS])
    assert len(one) > 400
    for name in ("t_ns", "pixel", "on"):
        assert np.array_equal(getattr(one, name), getattr(other, name))
    assert pixels.settled_ns == 200 * MS // 8_000 * 8_000


def test_the_sensor_uses_it_and_reads_out_what_is_settled():
    p = noisy(3)
    sensor = Sensor(p, 1)
    sensor.reset(LightFrame(12_345, still()))
    parts = [sensor.expose(LightFrame(t, still())) for t in range(MS, 200 * MS, MS)]
    events = np.concatenate([*parts, sensor.finish()])
    assert isinstance(sensor.pixels, NoisyPixels)
    assert len(events) == sensor.read_out > 300
    assert sensor.raised == sensor.lost_at_readout + sensor.read_out
    assert np.all(np.diff(events["t"].astype(int)) >= 0)


def test_hot_pixels_leak_at_their_rate_and_dead_ones_not_at_all():
    p = noisy(1000, leak_hz=1.0, leak_spread=0.0, parasitic_hz_at_reference=1.0,
              defects=DefectParameters(hot_share=0.3, hot_hz=20.0, dead_share=0.3))  # fmt: skip
    sensor, drawn = Sensor(p, 1), draw_defects(p, 1)
    sensor.reset(LightFrame(0, still()))
    events = sensor.expose(LightFrame(5 * S, still()))
    counts = np.bincount(events["y"].astype(int) * 8 + events["x"], minlength=40)
    expected = np.full(40, 10.0)
    expected[drawn.hot], expected[drawn.dead] = 5 * (drawn.hot_hz + 1), 0
    assert min(drawn.hot.size, drawn.dead.size) > 5
    assert np.abs(counts - expected).max() <= 1
    assert np.all(counts[drawn.dead] == 0)


def everything():
    return noisy(
        3.5, leak_hz=1.0, refractory_us=50.0, parasitic_hz_at_reference=0.5, source_follower_hz=400.0,
        readout=ReadoutParameters(event_ns=1.0, row_ns=0),
        temperature=TemperatureParameters(celsius=25.0),
        defects=DefectParameters(hot_share=0.05, dead_share=0.1),
        jitter=JitterParameters(latency_us=3.0, deviation_us=1.0, leak_share=0.2),
        imager=ImagerParameters(
            system_efficiency=0.8, quantum_efficiency=0.9, prnu=0.02, dcnu=0.3, photon_shot_noise=True,
            dark_shot_noise=True, electrons_per_s_at_reference=1e6,
        ),
        radiation=RadiationParameters(hits_per_cm2_s=1e6, dose_krad=5.0, dose_krad_per_day=1e4),
    )  # fmt: skip


def test_with_every_other_effect_nothing_is_lost_and_a_copy_goes_on_the_same():
    sensor = Sensor(everything(), 3)
    sensor.reset(LightFrame(0, drifting(0)))
    parts = [sensor.expose(LightFrame(t, drifting(t))) for t in range(333_333, 100 * MS, 333_333)]
    found = sum(map(len, parts))
    again = copy.deepcopy(sensor)
    for one in (sensor, again):
        late = [one.expose(LightFrame(t, drifting(t))) for t in range(100 * MS, 150 * MS, MS)]
        one.found = np.concatenate([*late, one.finish()])
        assert one.pending == 0
        assert one.raised == one.lost_in_pixel + one.lost_at_readout + one.read_out
        assert one.read_out == found + one.found.size
    assert np.array_equal(sensor.found, again.found)
    assert found > 300


@pytest.mark.sampled
@pytest.mark.parametrize("step_ns", [500_000, 5 * MS, 20 * MS])
def test_with_every_other_effect_steps_do_not_matter_in_still_light(step_ns):
    imager = dataclasses.replace(everything().imager, photon_shot_noise=False, dark_shot_noise=False)  # see `imager`

    def events(step_ns):
        sensor = Sensor(dataclasses.replace(everything(), imager=imager), 1)
        sensor.reset(LightFrame(0, still()))
        return np.concatenate([*(sensor.expose(LightFrame(t, still())) for t in range(step_ns, 200 * MS + 1, step_ns))])

    one, other = events(MS), events(step_ns)
    assert len(one) > 200
    assert np.array_equal(other, one)


def test_unreadable_light_is_counted_and_time_does_not_go_back():
    light = still()
    light[0, 0], light[0, 1] = np.nan, np.inf
    pixels = NoisyPixels(noisy(4), 1)
    pixels.reset(LightFrame(0, still()))
    pixels.step(LightFrame(MS, light))
    assert pixels.quiet_nan == 2
    with pytest.raises(ValueError, match="time does not go back"):
        pixels.step(LightFrame(MS - 1, still()))
    with pytest.raises(ValueError, match="must be"):
        pixels.step(LightFrame(2 * MS, np.ones((2, 2), np.float32)))
    assert len(pixels.step(LightFrame(MS, still()))) == 0
