"""Efficiency, fixed pattern, dark current and the counting of electrons, as the pixels see them.

Each statistical test fails a good model with a probability of 1e-4 or less (the seeds are fixed).
"""

import dataclasses

import numpy as np
import pytest
from scipy import stats

from emulator.light import LightFrame, Region
from emulator.sensor.chip.imager import Imager, part_of_the_way
from emulator.sensor.parameters import ImagerParameters
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor

ALPHA = 1e-4
MS = 1_000_000
PLAIN = SensorParameters(
    width=120, height=100, threshold_on=0.2, threshold_off=0.2, leak_hz=0.0, dark_current_relative=0.01,
    readout=ReadoutParameters(event_ns=1.0, row_ns=0),
)  # fmt: skip
GRID_NS = 8_192_000


def imager(seed=1, p=PLAIN, **figures):
    return Imager(dataclasses.replace(p, imager=ImagerParameters(**figures)), seed)


def still(level=1.0):
    return np.full((100, 120), level, np.float32)


def current(one, light, t_ns=0):
    """The photocurrent i' that the array makes of what the imager gives it."""
    return one.see(LightFrame(t_ns, light)).light.astype(float) + one.dark_current_relative


def test_by_default_the_light_passes_as_it_is():
    frame = LightFrame(0, still(0.3), still(0.1))
    assert imager().see(frame) is frame
    assert imager().dark_current_relative == 0.01


def test_efficiencies_scale_light_and_its_derivative_but_not_the_dark_current():
    one = imager(system_efficiency=0.5, quantum_efficiency=0.8)
    assert current(one, still(2.0)) == pytest.approx(0.81)
    assert current(one, still(0.0)) == pytest.approx(0.01)
    assert one.see(LightFrame(0, still(), still(10.0))).rate == pytest.approx(4.0)
    assert one.see(LightFrame(0, still())).rate is None


def test_gains_are_normal_and_fixed():
    one = imager(prnu=0.05)
    gain = (current(one, still()) - 0.01).ravel()
    assert stats.kstest((gain - 1) / 0.05, "norm").pvalue > ALPHA
    assert np.array_equal(current(one, still()), current(one, still(), 10**18))
    assert (current(one, still(2.0)) - 0.01).ravel() == pytest.approx(2 * gain, rel=1e-5)
    assert not np.array_equal(gain, (current(imager(seed=2, prnu=0.05), still()) - 0.01).ravel())


def test_dark_currents_are_log_normal_around_the_sensors():
    dark = current(imager(dcnu=0.5), still(0.0)).ravel()
    assert stats.kstest((np.log(dark / 0.01) + 0.125) / 0.5, "norm").pvalue > ALPHA
    assert dark.mean() == pytest.approx(0.01, rel=0.03)
    assert imager(dcnu=0.5).see(LightFrame(0, still(-1.0))).light.min() >= 0


@pytest.mark.parametrize(("level", "photon", "dark"), [(1.0, True, True), (0.02, True, False), (0.02, False, True)])
def test_counts_vary_as_counts_do(level, photon, dark):
    electrons = 1e5
    one = imager(photon_shot_noise=photon, dark_shot_noise=dark, electrons_per_s_at_reference=electrons)
    i = current(one, still(level), 4 * GRID_NS).ravel()
    mean = level + 0.01
    counted = electrons * GRID_NS * 1e-9 * (photon * level + dark * 0.01)
    deviation = np.sqrt(counted) / (electrons * GRID_NS * 1e-9 * mean)
    assert stats.kstest((np.log(i / mean) + deviation**2 / 2) / deviation, "norm").pvalue > ALPHA
    assert i.mean() == pytest.approx(mean, abs=4 * mean * deviation / np.sqrt(i.size))


def test_between_grid_times_the_log_goes_straight_and_the_mean_stays():
    one = imager(photon_shot_noise=True, electrons_per_s_at_reference=2e4)
    s2 = 1 / (2e4 * GRID_NS * 1e-9 * 1.01) / 1.01
    times = [k * GRID_NS // 4 for k in range(5)]
    m = np.array([np.log(current(one, still(), t).ravel() / 1.01) for t in times])
    x = np.arange(5)[:, None] / 4
    straight = m + s2 * ((1 - x) ** 2 + x**2) / 2
    assert straight[2] == pytest.approx((straight[0] + straight[4]) / 2, abs=2e-6)
    assert straight[1] == pytest.approx(0.75 * straight[0] + 0.25 * straight[4], abs=2e-6)
    assert np.exp(m).mean(axis=1) == pytest.approx(1, abs=4 * np.sqrt(s2 / m.shape[1]))


def test_counted_light_has_no_derivative():
    frame = LightFrame(0, still(), still(), changed=Region(0, 1, 0, 1))
    for figures in ({"photon_shot_noise": True}, {"dark_shot_noise": True, "system_efficiency": 0.5}):
        seen = imager(**figures).see(frame)
        assert seen.rate is None
        assert seen.changed is None, "the counts of all pixels change"


def test_neighbouring_grid_times_and_pixels_are_independent():
    one = imager(photon_shot_noise=True, electrons_per_s_at_reference=2e4)
    m = np.log(np.array([current(one, still(), k * GRID_NS).ravel() for k in range(3)]))
    for a, b in ((m[0], m[1]), (m[0], m[2]), (m[0][1:], m[0][:-1])):
        assert stats.pearsonr(a, b).pvalue > ALPHA / 3


def test_light_that_is_not_finite_stays_so_and_none_becomes_negative():
    light = still(0.0)
    light[0, 0], light[0, 1], light[0, 2] = np.nan, np.inf, -3.0
    for figures in ({"prnu": 0.1, "dcnu": 1.0}, {"dark_shot_noise": True, "electrons_per_s_at_reference": 1e4}):
        seen = imager(**figures).see(LightFrame(0, light)).light
        assert not np.isfinite(seen[0, :2]).any()
        assert seen.ravel()[2:].min() >= 0


@pytest.mark.parametrize("counted", [False, True])
def test_the_pixels_have_the_current_that_the_imager_means(counted):
    figures = ImagerParameters(dcnu=0.3, prnu=0.02, dark_shot_noise=counted, electrons_per_s_at_reference=1e7)
    p = dataclasses.replace(PLAIN, imager=figures)
    sensor = Sensor(p, 1)
    sensor.reset(LightFrame(0, still(0.02)))
    has = np.exp(sensor.pixels.field(Field.LOG_LIGHT))
    assert has == pytest.approx(current(Imager(p, 1), still(0.02)), rel=1e-5)
    assert has.mean() == pytest.approx(0.03, rel=0.01)


def test_the_light_part_of_the_way_is_straight_in_the_log():
    before = np.float32([0.0, 1.0, 0.5, 1e6, np.nan, 1.0, np.inf, -1.0, 1e-6])
    after = np.float32([1.0, 0.0, 0.5, 1e-3, 1.0, np.nan, 2.0, 1.0, 1e5])
    out = np.empty_like(before)
    part_of_the_way(before, after, np.float32(0.01), np.float32(0.25), out)
    first, last = np.maximum(before, 0) + 0.01, np.maximum(after, 0) + 0.01
    with np.errstate(invalid="ignore"):
        expected = first * (last / first) ** 0.25 - 0.01
    expected[[4, 5, 6]] = after[[4, 5, 6]]
    assert out == pytest.approx(expected, rel=3e-6, nan_ok=True)
    assert out[2] == 0.5


def counted_events(step_ns):
    p = dataclasses.replace(
        PLAIN, imager=ImagerParameters(photon_shot_noise=True, electrons_per_s_at_reference=2e4), mismatch=0.0
    )
    sensor = Sensor(p, 1)
    sensor.reset(LightFrame(0, still()))
    parts = [sensor.expose(LightFrame(t, still())) for t in range(step_ns, 400 * MS + 1, step_ns)]
    return np.concatenate([*parts, sensor.finish()])


@pytest.mark.parametrize("step_ns", [500_000, 5 * MS, 20 * MS])
def test_what_shot_noise_makes_of_still_light_does_not_depend_on_the_step(step_ns):
    one, other = counted_events(MS), counted_events(step_ns)
    assert len(one) > 1000
    assert len(other) == pytest.approx(len(one), rel=0.003)
    keys = [set(zip(e["x"], e["y"], e["on"], (e["t"] // 1000).astype(int), strict=True)) for e in (one, other)]
    assert len(keys[0] & keys[1]) > 0.9 * len(keys[0])
