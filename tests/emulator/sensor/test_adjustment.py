"""Figures that change while a sensor runs, beside closed forms and beside sensors that had them from the start."""

import dataclasses
import math

import numba
import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.numerics.keyed import Purpose, uniform
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor

_STEP_NS = 1_000_000
_PLAIN = SensorParameters(
    width=40,
    height=30,
    threshold_on=0.2,
    threshold_off=0.3,
    mismatch=0.0,
    dark_current_relative=1e-9,
    corner_hz_at_reference=1e9,
    corner_max_hz=1e9,
    leak_hz=0.0,
    readout=ReadoutParameters(event_ns=0.001, row_ns=0),
)


def _light(value):
    return np.full((_PLAIN.height, _PLAIN.width), value, np.float32)


def _ramp(sensor, growth, steps=100, start=0, first=0.0):
    """Let ln of the light grow by `growth` from `first` in `steps`; return the events."""
    shares = (np.arange(steps) + 1) / steps
    parts = [
        sensor.expose(LightFrame((start + k + 1) * _STEP_NS, _light(np.exp(first + growth * share))))
        for k, share in enumerate(shares)
    ]
    return np.concatenate(parts)


@pytest.mark.parametrize("threshold", [0.12, 0.4, 1.1])
def test_on_events_after_a_change_of_threshold_are_those_of_the_closed_form(threshold):
    sensor = Sensor(_PLAIN, 3)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.adjust("threshold_on", threshold)
    events = np.concatenate([_ramp(sensor, 1.7), sensor.finish()])

    phase = uniform(3, Purpose.LEAK_PHASE, np.arange(_PLAIN.width * _PLAIN.height))
    expected = np.floor((1.7 + 0.2 * phase) / threshold)  # the first reference lies a share of the old threshold below
    counted = np.bincount(events["y"].astype(int) * _PLAIN.width + events["x"], minlength=expected.size)
    assert events["on"].all()
    # where the level ends within rounding of a threshold either count is right
    close = np.abs((1.7 + 0.2 * phase) / threshold % 1 - 0.5) > 0.499
    assert np.array_equal(counted[~close], expected[~close])
    assert close.mean() < 0.02


@pytest.mark.parametrize("off", [0.3, 0.15])
def test_off_events_follow_their_own_threshold_and_on_events_do_not(off):
    sensor = Sensor(_PLAIN, 3)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.adjust("threshold_off", off)
    up = _ramp(sensor, 2.0)
    down = np.concatenate([_ramp(sensor, -2.0, start=100, first=2.0), sensor.finish()])
    risen = 2.0 + 0.2 * uniform(3, Purpose.LEAK_PHASE, np.arange(_PLAIN.width * _PLAIN.height))
    assert len(up) == pytest.approx(np.floor(risen / 0.2).sum(), rel=1e-3)
    assert len(down) == pytest.approx(np.floor((2.0 - risen % 0.2) / off).sum(), rel=1e-3)
    assert not down["on"].any()


def test_a_changed_leak_has_its_rate_from_then_on_and_none_at_once():
    sensor = Sensor(dataclasses.replace(_PLAIN, leak_hz=1.0, leak_spread=0.0), 5)
    sensor.reset(LightFrame(0, _light(1.0)))
    pixels = _PLAIN.width * _PLAIN.height
    first = sum(len(sensor.expose(LightFrame((k + 1) * 10 * _STEP_NS, _light(1.0)))) for k in range(200))  # 2 s at 1 Hz
    sensor.adjust("leak_hz", 4.0)
    at_once = len(sensor.expose(LightFrame(200 * 10 * _STEP_NS + 1000, _light(1.0))))
    later = sum(
        len(sensor.expose(LightFrame((k + 201) * 10 * _STEP_NS, _light(1.0)))) for k in range(200)
    )  # 2 s at 4 Hz
    assert first == pytest.approx(2 * pixels, rel=0.01)
    assert at_once <= 1
    assert later == pytest.approx(8 * pixels, rel=0.01)


def test_leak_can_be_switched_on():
    sensor = Sensor(dataclasses.replace(_PLAIN, leak_spread=0.0), 5)
    sensor.reset(LightFrame(0, _light(1.0)))
    assert len(sensor.expose(LightFrame(1_000 * _STEP_NS, _light(1.0)))) == 0
    sensor.adjust("leak_hz", 3.0)
    events = len(sensor.expose(LightFrame(3_000 * _STEP_NS, _light(1.0))))
    assert events == pytest.approx(6 * _PLAIN.width * _PLAIN.height, rel=0.02)


def test_a_new_on_threshold_keeps_the_rate_of_leak_events():
    sensor = Sensor(dataclasses.replace(_PLAIN, leak_hz=2.0, leak_spread=0.0), 5)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.expose(LightFrame(1_000 * _STEP_NS, _light(1.0)))
    sensor.adjust("threshold_on", 0.5)
    sensor.expose(LightFrame(2_000 * _STEP_NS, _light(1.0)))
    events = len(sensor.expose(LightFrame(4_000 * _STEP_NS, _light(1.0))))
    assert events == pytest.approx(4 * _PLAIN.width * _PLAIN.height, rel=0.01)


def test_a_long_refractory_period_bounds_the_rate_of_a_pixel():
    sensor = Sensor(_PLAIN, 3)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.adjust("refractory_us", 30_000.0)
    events = _ramp(sensor, 3.0)  # 100 ms: 15 thresholds; with the pause one each 36.7 ms, the first before 6.7
    assert set(np.bincount(events["y"].astype(int) * _PLAIN.width + events["x"])) == {3}


def test_a_low_corner_delays_a_step_of_light_by_its_closed_form():
    sensor = Sensor(_PLAIN, 3)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.adjust("corner_max_hz", 10.0)
    sensor.expose(LightFrame(_STEP_NS, _light(1.0)))
    sensor.expose(LightFrame(_STEP_NS + 1000, _light(np.e)))  # at once
    events = np.concatenate([sensor.expose(LightFrame((k + 2) * _STEP_NS, _light(np.e))) for k in range(300)])
    phase = uniform(3, Purpose.LEAK_PHASE, np.arange(_PLAIN.width * _PLAIN.height))
    pixel = events["y"].astype(int) * _PLAIN.width + events["x"]
    _, first = np.unique(pixel, return_index=True)
    rise = 0.2 * (1 - phase)
    expected_us = 1001.0 - np.log(1 - rise) / (2 * np.pi * 10.0) * 1e6
    assert np.abs(events["t"][first] - expected_us).max() < 3.0


@pytest.mark.parametrize(("name", "value"), [("threshold_on", 0.0), ("leak_hz", -1.0), ("corner_max_hz", 0.1)])
def test_what_is_not_allowed_is_refused_and_nothing_changes(name, value):
    sensor = Sensor(_PLAIN, 3)
    before = dict(sensor.adjustable)
    with pytest.raises(ValueError, match=name):
        sensor.adjust(name, value)
    assert sensor.adjustable == before


def test_other_figures_cannot_be_changed():
    with pytest.raises(ValueError, match="width cannot be changed"):
        Sensor(_PLAIN, 3).adjust("width", 3)


def test_the_thresholds_of_a_pixel_are_the_distances_of_its_events():
    spread = dataclasses.replace(_PLAIN, mismatch=0.03)
    sensor = Sensor(spread, 3)
    sensor.reset(LightFrame(0, _light(1.0)))
    sensor.adjust("threshold_on", 0.25)
    events = np.concatenate([_ramp(sensor, 2.0), _ramp(sensor, -2.0, start=100, first=2.0), sensor.finish()])
    assert len({sensor.thresholds_of(x, y) for x, y in ((0, 0), (7, 11), (39, 29))}) == 3
    for x, y in ((0, 0), (7, 11), (39, 29)):
        own = events[(events["x"] == x) & (events["y"] == y)]
        for threshold, polarity in zip(sensor.thresholds_of(x, y), (True, False), strict=True):
            steps_us = np.diff(own["t"][own["on"] == polarity].astype(float))
            # 2 ln units in 100 ms are 0.02 ln units a millisecond; times are whole microseconds
            assert steps_us / 50_000 == pytest.approx(threshold, abs=1.5 / 50_000)


@pytest.mark.parametrize(("x", "y"), [(40, 0), (0, 30), (-1, 0), (0, -1)])
def test_a_pixel_beside_the_sensor_has_no_thresholds(x, y):
    with pytest.raises(ValueError, match="40 x 30"):
        Sensor(_PLAIN, 3).thresholds_of(x, y)


_NOISY = dataclasses.replace(
    PRESETS["davis346"], width=40, height=30, leak_hz=0.0, mismatch=0.0, refractory_us=0.0, source_follower_hz=0.0,
    noise=NoiseParameters(rms=0.08),
)  # fmt: skip


def _noise_events(sensor, ends_ms):
    return np.concatenate([sensor.expose(LightFrame(end * _STEP_NS, _light(0.05))) for end in ends_ms])


@numba.njit
def _followed(phases, first, second, edges, random):
    """Events before each edge of pixels whose thresholds change at the first; deviations and time constants."""
    counts, step = np.zeros(edges.size + 1), 0.01
    decay, kick = math.exp(-step), math.sqrt(-math.expm1(-2 * step))
    for phase in phases:
        x, reference, t = random.normal(), -phase * first[0], 0.0
        while t < edges[-1]:
            on, off = first if t < edges[0] else second
            y = x * decay + kick * random.normal()
            t += step
            up, down = reference + on, reference - off
            if y >= up or (y > down and random.random() < math.exp(-max(0.0, (up - x) * (up - y)) / step)):
                y = up
            elif y <= down or random.random() < math.exp(-max(0.0, (x - down) * (y - down)) / step):
                y = down
            if not down < y < up:
                counts[np.searchsorted(edges, t)] += 1
                reference = y
            x = y
    return counts


@pytest.mark.long
@pytest.mark.system
@pytest.mark.parametrize("off", [0.2, 0.35])
def test_noise_follows_a_changed_threshold(off):
    """As a process in fine steps, which keeps its levels: for seconds they are not those of the new threshold alone."""
    changed, end_ms = Sensor(_NOISY, 7), 6505
    changed.reset(LightFrame(0, _light(0.05)))
    found = [len(_noise_events(changed, (500, 1000, 1505)))]  # in the middle of a window of noise
    changed.adjust("threshold_off", off)
    found += [len(_noise_events(changed, tuple(range(1605, end_ms + 1, 100))))]

    per_s = 2 * math.pi * _NOISY.corner_hz_at_reference * (0.05 + _NOISY.dark_current_relative)
    first, second = ((_NOISY.threshold_on / 0.08, one / 0.08) for one in (_NOISY.threshold_off, off))
    phases = np.random.default_rng(1).random(_NOISY.width * _NOISY.height)
    wanted = _followed(phases, first, second, np.array([1.505, end_ms * 1e-3]) * per_s, np.random.default_rng(3))
    # within 5 %, and 4 standard errors of counts that spread from pixel to pixel as if events came in groups of ten
    assert found == pytest.approx(wanted[:2], rel=0.05 + 4 * math.sqrt(2 * 10 / wanted[:2].min()))


def test_rates_after_a_change_do_not_depend_on_the_steps():
    found = []
    for step_ms in (1, 5):
        sensor = Sensor(_NOISY, 7)
        sensor.reset(LightFrame(0, _light(0.05)))
        parts = [_noise_events(sensor, tuple(range(step_ms, 101, step_ms)))]
        sensor.adjust("threshold_on", 0.22)
        parts += [_noise_events(sensor, tuple(range(100 + step_ms, 301, step_ms))), sensor.finish()]
        found.append(np.concatenate(parts))
    few, many = sorted(map(len, found))
    assert few > 500
    # within 2 %, and 3.9 standard errors (1e-4): single events follow the steps
    assert many - few < 0.02 * many + 3.9 * math.sqrt(few + many)
