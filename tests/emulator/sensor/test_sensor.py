"""The whole sensor: parts that are off are not there, effects have their rates, and every event has one fate.

Each statistical test fails a good model with a probability of 1e-4 or less (the seeds are fixed).
"""

import copy
import dataclasses
import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy import stats

from emulator.light import LightFrame
from emulator.sensor.chip.defects import at_temperature, draw_defects
from emulator.sensor.chip.readout import ArbiterReadOut
from emulator.sensor.parameters import (
    ComparatorParameters,
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    ResetParameters,
    TemperatureParameters,
)
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import Field
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.accuracy.peers.pangu import Pangu

ALPHA = 1e-4
MS = 1_000_000
S = 1000 * MS
EPOCH_NS = 1 << 33
DAYS_30 = 30 * 86_400 * S // EPOCH_NS * EPOCH_NS
PLAIN = SensorParameters(
    width=40, height=30, threshold_on=0.2, threshold_off=0.2, leak_hz=0.0, corner_hz_at_reference=300.0,
    readout=ReadoutParameters(event_ns=1.0, row_ns=0),
)  # fmt: skip
PIXELS = PLAIN.width * PLAIN.height


def with_(p=PLAIN, **changes):
    return dataclasses.replace(p, **changes)


def still(level=1.0, p=PLAIN):
    return np.full((p.height, p.width), level, np.float32)


def drifting(t_ns, p=PLAIN):
    y, x = np.mgrid[: p.height, : p.width]
    return np.exp(0.8 * np.sin(0.3 * x + 0.2 * y - 40e-9 * t_ns)).astype(np.float32)


def run(p=PLAIN, *, seed=1, step_ns=MS, end_ns=S, scene=None, start_ns=0, make_pixels=PixelArray):
    scene = scene or (lambda t_ns: still(p=p))
    sensor = Sensor(p, seed, make_pixels)
    sensor.reset(LightFrame(start_ns, scene(start_ns)))
    times = [*range(start_ns + step_ns, start_ns + end_ns, step_ns), start_ns + end_ns]
    parts = [sensor.expose(LightFrame(t, scene(t))) for t in times]
    return np.concatenate([*parts, sensor.finish()]), sensor


def pixel_of(events, p=PLAIN):
    return events["y"].astype(int) * p.width + events["x"]


def assert_balance(sensor):
    assert sensor.pending == 0
    assert sensor.raised == sensor.lost_in_pixel + sensor.lost_at_readout + sensor.read_out


def test_with_everything_off_it_is_pixels_and_read_out():
    p = with_(leak_hz=5.0)
    found, sensor = run(p, scene=drifting, end_ns=100 * MS)
    pixels, readout = PixelArray(p, 1), ArbiterReadOut(p)
    pixels.reset(LightFrame(0, drifting(0)))
    parts = [readout.push(pixels.step(LightFrame(t, drifting(t))), t) for t in range(MS, 101 * MS, MS)]
    assert len(found) > 10_000
    assert np.array_equal(found, np.concatenate([*parts, readout.finish()]))
    assert_balance(sensor)


def test_the_lights_slope_reaches_the_pixels():
    def slope(t_ns):
        return ((drifting(t_ns + 1000) - drifting(t_ns - 1000)) / 2e-6).astype(np.float32)

    gains = with_(imager=ImagerParameters(system_efficiency=0.5))
    sensor, pixels = Sensor(gains, 1), PixelArray(PLAIN, 1)
    sensor.reset(LightFrame(0, 2 * drifting(0)))
    pixels.reset(LightFrame(0, drifting(0)))
    for t in range(10 * MS, 50 * MS, 10 * MS):
        events = sensor.expose(LightFrame(t, 2 * drifting(t), 2 * slope(t)))
        crossings = pixels.step(LightFrame(t, drifting(t), slope(t)))
        assert len(events) == pytest.approx(len(crossings), rel=0.01)
        assert abs(np.median(events["t"]) - np.median(crossings.t_ns / 1000)) < 20
        straight = PixelArray(PLAIN, 1)
        straight.reset(LightFrame(t - 10 * MS, drifting(t - 10 * MS)))
        assert len(straight.step(LightFrame(t, drifting(t)))) > 500


@pytest.mark.system
@pytest.mark.parametrize(
    ("level", "hz", "step_ns"), [(1.0, 3.0, 100_000), (1.0, 3.0, 20 * MS), (0.25, 1.5, MS), (0.0, 1.0, 20 * MS)]
)
def test_leak_has_a_part_of_its_own_and_one_of_the_light(level, hz, step_ns):
    p = with_(leak_hz=1.0, parasitic_hz_at_reference=2.0, width=20, height=20)
    found, sensor = run(p, step_ns=step_ns, end_ns=2 * S, scene=lambda t: still(level, p))
    assert sensor.raised / 400 / 2 == pytest.approx(hz, rel=0.03)
    assert np.all(found["on"])


def test_leak_is_log_normal_from_pixel_to_pixel():
    p = with_(leak_hz=5.0, leak_spread=0.4)
    found, _ = run(p, step_ns=20 * MS, end_ns=40 * S)
    hz = np.bincount(pixel_of(found), minlength=PIXELS) / 40
    assert stats.kstest((np.log(hz / 5) + 0.08) / 0.4, "norm").pvalue > ALPHA


def test_hot_pixels_have_their_own_rate_and_spread():
    p = with_(leak_hz=0.1, defects=DefectParameters(hot_share=0.3, hot_hz=20.0, hot_spread=0.5))
    found, _ = run(p, step_ns=10 * MS, end_ns=20 * S)
    hot = draw_defects(p, 1).hot
    assert stats.binomtest(hot.size, PIXELS, 0.3).pvalue > ALPHA
    hz = np.bincount(pixel_of(found)[found["on"]], minlength=PIXELS) / 20
    assert stats.kstest(np.log(hz[hot] / 20) / 0.5, "norm").pvalue > ALPHA
    assert hz[hot] == pytest.approx(draw_defects(p, 1).hot_hz, abs=0.06)
    assert hz[np.setdiff1d(np.arange(PIXELS), hot)].mean() == pytest.approx(0.1, rel=0.1)
    assert np.all(found["on"])


def test_listed_defects_are_where_the_rig_says():
    p = with_(defects=DefectParameters(hot_pixels=((3, 2), (39, 29)), dead_pixels=((5, 7), (3, 2)), hot_spread=0.0))
    found, _ = run(p, end_ns=2 * S)
    assert set(pixel_of(found)) == {29 * 40 + 39}  # the pixel that is both is dead
    assert len(found) == pytest.approx(2 * 20, abs=1)


def test_dead_pixels_see_nothing_at_all():
    p = with_(
        leak_hz=10.0, parasitic_hz_at_reference=10.0, defects=DefectParameters(dead_share=0.25),
        noise=NoiseParameters(rms=0.06),
    )  # fmt: skip
    found, _ = run(p, end_ns=200 * MS, scene=drifting)
    dead = draw_defects(p, 1).dead
    assert stats.binomtest(dead.size, PIXELS, 0.25).pvalue > ALPHA
    assert set(range(PIXELS)) - set(pixel_of(found)) == set(dead)


def test_a_sensor_of_dead_pixels_alone_is_silent():
    p = with_(leak_hz=10.0, defects=DefectParameters(dead_share=1.0), noise=NoiseParameters(rms=0.06))
    found, sensor = run(p, end_ns=50 * MS, scene=drifting)
    assert len(found) == sensor.raised == 0


@pytest.mark.parametrize(("celsius", "factor"), [(20.0, 1), (29.0, 2), (2.0, 0.25)])
def test_leak_doubles_with_temperature(celsius, factor):
    p = with_(leak_hz=2.0, temperature=TemperatureParameters(celsius=celsius))
    found, _ = run(p, step_ns=10 * MS, end_ns=10 * S)
    assert len(found) / PIXELS / 10 == pytest.approx(2 * factor, rel=0.03)


def test_dark_current_and_hot_pixels_follow_the_temperature():
    p = with_(temperature=TemperatureParameters(celsius=36.0), defects=DefectParameters(hot_share=0.1, hot_hz=4.0))
    warm = at_temperature(p)
    assert warm.dark_current_relative == pytest.approx(4 * p.dark_current_relative)
    assert warm.corner_min_hz == pytest.approx(4 * p.corner_min_hz)
    assert warm.defects.hot_hz == pytest.approx(4 * 2 ** (16 / 9))
    assert at_temperature(warm) == warm


def test_a_temperature_at_which_nothing_works_is_refused():
    hot = TemperatureParameters(celsius=110.0)  # leak 1024 times what it is at 20
    assert at_temperature(with_(leak_hz=0.1, temperature=hot)).defects.hot_hz == 20.0  # there are none
    for too_much in (
        with_(temperature=hot, defects=DefectParameters(hot_share=0.1)),
        with_(temperature=hot, radiation=RadiationParameters(dose_krad=1.0)),
        with_(leak_hz=20.0, temperature=hot),
        with_(leak_hz=0.0, dark_current_relative=1.0, temperature=TemperatureParameters(celsius=200.0)),
        with_(leak_hz=0.0, dark_current_relative=1e-25, temperature=TemperatureParameters(celsius=-200.0)),
    ):
        with pytest.raises(ValueError, match=r"^temperature\.celsius = "):
            Sensor(too_much, 1)


@pytest.mark.system
@pytest.mark.parametrize("step_ns", [500_000, 5 * MS, 20 * MS])
def test_rates_of_noise_do_not_depend_on_the_step(step_ns):
    p = with_(noise=NoiseParameters(rms=0.06, corner_hz=300.0), radiation=RadiationParameters(hits_per_cm2_s=2e4))
    few, many = sorted(len(run(p, **step)[0]) for step in ({}, {"step_ns": step_ns}))
    assert few > 500
    # within 2 %, and 3.9 standard errors (1e-4): single events follow the steps
    assert many - few < 0.02 * many + 3.9 * math.sqrt(few + many)


def everything():
    return with_(
        leak_hz=1.0,
        refractory_us=50.0,
        temperature=TemperatureParameters(celsius=25.0),
        defects=DefectParameters(hot_share=0.02, dead_share=0.02),
        noise=NoiseParameters(rms=0.06, corner_hz=300.0),
        jitter=JitterParameters(latency_us=50.0, deviation_us=100.0, leak_share=0.2),
        imager=ImagerParameters(
            system_efficiency=0.8, quantum_efficiency=0.9, prnu=0.02, dcnu=0.3, photon_shot_noise=True,
            dark_shot_noise=True, electrons_per_s_at_reference=1e5,
        ),
        radiation=RadiationParameters(hits_per_cm2_s=1e4, dose_krad=5.0, dose_krad_per_day=1e4),
        comparator=ComparatorParameters(on_us=1.0, off_us=200.0),
        reset=ResetParameters(offset=0.02, noise=0.01, at_acknowledge=True),
    )  # fmt: skip


def test_with_everything_on_the_books_balance_and_a_copy_goes_on_the_same():
    p = everything()
    sensor = Sensor(p, 3)
    sensor.reset(LightFrame(0, drifting(0)))
    for t in range(MS, 100 * MS, MS):
        sensor.expose(LightFrame(t, drifting(t)))
    again = copy.deepcopy(sensor)
    for one in (sensor, again):
        found = [one.expose(LightFrame(t, drifting(t))) for t in range(100 * MS, 200 * MS, MS)]
        one.found = np.concatenate([*found, one.finish()])
        assert_balance(one)
    assert len(sensor.found) > 1000
    assert np.array_equal(sensor.found, again.found)
    assert np.all(np.diff(sensor.found["t"].astype(np.int64)) >= 0)


def test_a_restart_is_a_fresh_start():
    p = everything()
    used, fresh = Sensor(p, 3), Sensor(p, 3)
    used.reset(LightFrame(0, drifting(0)))
    for t in range(MS, 60 * MS, MS):
        used.expose(LightFrame(t, drifting(t)))
    for one in (used, fresh):
        one.reset(LightFrame(77 * MS, drifting(77 * MS)))
        found = [one.expose(LightFrame(t, drifting(t))) for t in range(78 * MS, 130 * MS, MS)]
        one.found = np.concatenate([*found, one.finish()])
        assert_balance(one)
    assert len(fresh.found) > 1000
    assert np.array_equal(used.found, fresh.found)


def test_a_cut_within_a_step_takes_the_light_part_of_the_way():
    """Leak that changes where a stretch ends cuts a step there; when it hardly changes, events must stay."""
    begin_ns, end_ns = EPOCH_NS - 5 * MS, EPOCH_NS + 5 * MS
    found = []
    for share in (0.0, 1e-6):
        sensor = Sensor(with_(leak_hz=0.01, jitter=JitterParameters(leak_share=share)), 1)
        sensor.reset(LightFrame(begin_ns, still()))
        events = np.concatenate([sensor.expose(LightFrame(end_ns, still(np.exp(0.5)))), sensor.finish()])
        found.append(events[np.lexsort([events["t"], pixel_of(events)])])
    assert len(found[0]) > PIXELS
    assert np.array_equal(found[0][["x", "y", "on"]], found[1][["x", "y", "on"]])
    off_us = np.abs(found[0]["t"].astype(int) - found[1]["t"].astype(int))
    assert off_us.max() < 100  # two pieces solve the filter better than one


def test_particles_do_not_wake_the_dead():
    p = with_(defects=DefectParameters(dead_share=0.5), radiation=RadiationParameters(hits_per_cm2_s=1e6))
    found, _ = run(p, end_ns=100 * MS)
    assert len(found) > 200
    assert not np.isin(pixel_of(found), draw_defects(p, 1).dead).any()


def test_pixels_turn_hot_within_a_stretch_of_leak_jitter():
    radiation = RadiationParameters(dose_krad_per_day=1e4, hot_share_per_krad=1e-2)
    p = with_(leak_hz=0.0, jitter=JitterParameters(leak_share=0.1), radiation=radiation)
    defects = draw_defects(p, 1)
    first_ns = int(defects.hot_from_ns[0])
    assert 0 < first_ns < EPOCH_NS
    sensor = Sensor(p, 1)
    sensor.reset(LightFrame(0, still()))
    leaks = []
    for t_ns in (first_ns - 1, first_ns + 1):
        sensor.expose(LightFrame(t_ns, still()))
        leaks.append(sensor.pixels.field(Field.LEAK).ravel()[defects.hot[0]])
    assert leaks[0] == 0 < leaks[1]


@settings(max_examples=settings.default.max_examples // 2)
@given(steps=st.lists(st.integers(0, 40 * MS), min_size=1, max_size=12), seed=st.integers(0, 2**32))
def test_every_event_has_one_fate(steps, seed):
    sensor = Sensor(everything(), seed)
    sensor.reset(LightFrame(0, drifting(0)))
    read, t = 0, 0
    for step in steps:
        t += step
        read += len(sensor.expose(LightFrame(t, drifting(t))))
        assert sensor.raised == sensor.lost_in_pixel + sensor.lost_at_readout + sensor.read_out + sensor.pending
    read += len(sensor.finish())
    assert read == sensor.read_out
    assert_balance(sensor)


def test_thirty_days_later_everything_but_the_draws_is_the_same():
    p = with_(leak_hz=5.0, defects=DefectParameters(hot_share=0.05))
    first, _ = run(p, end_ns=300 * MS, scene=lambda t: drifting(t % EPOCH_NS))
    late, _ = run(p, end_ns=300 * MS, scene=lambda t: drifting(t % EPOCH_NS), start_ns=DAYS_30)
    late["t"] -= DAYS_30 // 1000
    assert np.array_equal(late[["x", "y", "on"]], first[["x", "y", "on"]])
    assert np.all(np.abs(late["t"].astype(int) - first["t"].astype(int)) <= 1)  # whole us, from another whole ns


def test_seeds_differ_and_repeat():
    first, again, other = (run(everything(), seed=seed, end_ns=50 * MS, scene=drifting)[0] for seed in (1, 1, 2))
    assert np.array_equal(first, again)
    assert not np.array_equal(first, other)


def test_leak_jitter_varies_a_pixels_intervals_and_keeps_the_rate():
    p = with_(leak_hz=0.5, leak_spread=0.0, jitter=JitterParameters(leak_share=0.2))
    sensor = Sensor(p, 1)
    sensor.reset(LightFrame(0, still()))
    leaks = []
    for k in range(1, 31):
        sensor.expose(LightFrame(k * EPOCH_NS, still()))
        sensor.expose(LightFrame(k * EPOCH_NS + 1, still()))
        leaks.append(sensor.pixels.field(Field.LEAK) / sensor.pixels.field(Field.ON))
    hz = np.array(leaks).reshape(30, -1)
    assert stats.kstest(hz.ravel() / 0.5, "norm", (1, 0.2)).pvalue > ALPHA
    assert all(abs(stats.pearsonr(a, b).statistic) < 0.15 for a, b in zip(hz[1:], hz[:-1], strict=True))
    assert sensor.raised / PIXELS / (30 * EPOCH_NS * 1e-9) == pytest.approx(0.5, rel=0.01)


def test_leak_jitter_does_not_depend_on_the_step():
    p = with_(leak_hz=2.0, jitter=JitterParameters(leak_share=0.3))
    a, b = (run(p, step_ns=step, end_ns=20 * S)[0] for step in (7 * MS, 500 * MS))
    assert len(a) == len(b) > 40 * PIXELS * 0.9
    order_a, order_b = (np.lexsort([e["t"], pixel_of(e)]) for e in (a, b))
    drift_us = a["t"][order_a].astype(int) - b["t"][order_b].astype(int)
    assert np.array_equal(pixel_of(a)[order_a], pixel_of(b)[order_b])
    assert np.abs(drift_us).max() < 200  # of 500 000 between events: float32 references


def test_dose_turns_pixels_hot_and_they_stay_so():
    p = with_(radiation=RadiationParameters(dose_krad=50.0, hot_share_per_krad=1e-2, dose_krad_per_day=1e4))
    defects = draw_defects(p, 1)
    at_start = np.count_nonzero(defects.hot_from_ns < 0)
    assert stats.binomtest(at_start, PIXELS, 1 - np.exp(-0.5)).pvalue > ALPHA
    in_a_minute = np.count_nonzero(defects.hot_from_ns < 60 * S)
    assert stats.binomtest(in_a_minute, PIXELS, 1 - np.exp(-0.5 - 1e4 / 1440 * 1e-2)).pvalue > ALPHA
    less = draw_defects(with_(radiation=RadiationParameters(dose_krad=20.0, hot_share_per_krad=1e-2)), 1)
    assert set(less.hot) < set(defects.hot[:at_start])
    found, _ = run(p, step_ns=20 * MS, end_ns=60 * S)
    t_ns, pixel = found["t"] * 1000, pixel_of(found)
    late = (defects.hot_from_ns > 0) & (defects.hot_from_ns < 50 * S)
    assert late.sum() > 3
    for one, from_ns, hz in zip(defects.hot[late], defects.hot_from_ns[late], defects.hot_hz[late], strict=True):
        mine = t_ns[pixel == one]
        assert mine.min() > from_ns
        assert mine.size == pytest.approx(hz * (60 * S - from_ns) * 1e-9, abs=1.01)


def test_other_methods_take_the_pixels_place_but_have_no_defects():
    found, sensor = run(PLAIN, scene=drifting, end_ns=50 * MS, make_pixels=Pangu)
    assert len(found) > 1000
    assert_balance(sensor)
    for effect in (
        {"noise": NoiseParameters(rms=0.06)},
        {"defects": DefectParameters(dead_share=0.5)},
        {"jitter": JitterParameters(leak_share=0.1)},
        {"radiation": RadiationParameters(dose_krad=1000.0)},
    ):
        with pytest.raises(ValueError, match=r"need evstim's own pixels"):
            Sensor(with_(**effect), 1, Pangu)


def test_time_does_not_go_back_and_the_picture_must_fit():
    sensor = Sensor(PLAIN, 1)
    sensor.reset(LightFrame(5 * MS, still()))
    with pytest.raises(ValueError, match="time does not go back"):
        sensor.expose(LightFrame(4 * MS, still()))
    with pytest.raises(ValueError, match="must be"):
        sensor.expose(LightFrame(6 * MS, np.ones((3, 3), np.float32)))
    assert len(sensor.expose(LightFrame(5 * MS, still()))) == 0


def test_the_derivative_at_the_start_spares_the_first_step():
    """It needs no more pixels than the next one; without the derivative all pixels of the first step are solved.

    Without noise: pixels with noise get their first certificates in the first step.
    """
    p = dataclasses.replace(PRESETS["davis346"], width=40, height=30, noise=NoiseParameters())

    def frame(t_ns, known=True):
        light = drifting(t_ns)
        y, x = np.mgrid[: p.height, : p.width]
        rate = light * 0.8 * -40 * np.cos(0.3 * x + 0.2 * y - 40e-9 * t_ns)
        return LightFrame(t_ns, light, rate.astype(np.float32) if known else None)

    solved = []
    for known in (True, False):
        sensor = Sensor(p, 1)
        sensor.reset(frame(0, known))
        for t_ns in (MS, 2 * MS):
            sensor.expose(frame(t_ns))
            solved.append(sensor.pixels.candidates)
    assert solved[0] < 0.5 * PIXELS
    assert solved[2] >= PIXELS  # whole blocks
