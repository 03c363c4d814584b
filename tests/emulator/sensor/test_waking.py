"""Figures that change over still light: the events are those of a sensor that skips no pixel, bit for bit."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.parameters import JitterParameters, NoiseParameters, TemperatureParameters
from emulator.sensor.pixels.method import ADJUSTABLE
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor

WIDTH, HEIGHT = 64, 32
MS = 1_000_000
EPOCH_MS = (1 << 33) / MS
CHANGED_AT, STEPS = 60, 120
RATIOS = (0.4, 2.5)
STILL = (0.1 + 0.5 * (np.add.outer(np.arange(HEIGHT) * 13, np.arange(WIDTH) * 7) % 11) / 11).astype(np.float32)
STILL[HEIGHT // 2 :] = 0
LIT = WIDTH * HEIGHT // 2
VARIANTS = {
    "preset": {},
    "noise of points": {"noise": NoiseParameters(rms=0.05, corner_hz=2000.0)},
    "leak course": {"jitter": JitterParameters(leak_share=0.5), "leak_hz": 0.5},
    "warm": {"temperature": TemperatureParameters(celsius=70.0)},
    "second pole and leaks": {"source_follower_hz": 300.0, "parasitic_hz_at_reference": 0.5, "leak_hz": 0.3},
}


def sensor(model, **changes):
    return Sensor(dataclasses.replace(PRESETS[model], width=WIDTH, height=HEIGHT, **changes), 1)


def events(one, changes, *, full, begin_ms=0):
    """Return the events of steps of 1 ms in still light; `changes`: (name, value) at a step; `full`: skip nothing."""
    # Brighter at first: then it falls, and some levels lie below their references.
    one.reset(LightFrame(begin_ms * MS, np.float32(1.15) * STILL))
    found = []
    for k in range(1, STEPS):
        if full and hasattr(one.pixels, "wake"):
            one.pixels.wake()
        for name, value in changes.get(k, ()):
            one.adjust(name, value)
        found.append(one.expose(LightFrame((begin_ms + k) * MS, STILL, np.zeros_like(STILL))))
    return np.concatenate([*found, one.finish()])


def assert_nothing_is_missed(make, changes, begin_ms=0):
    skipping = events(make(), changes, full=False, begin_ms=begin_ms)
    assert np.array_equal(skipping, events(make(), changes, full=True, begin_ms=begin_ms))
    return skipping


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("variant", VARIANTS)
@pytest.mark.parametrize("model", PRESETS)
def test_a_changed_figure_acts_on_pixels_that_rest(model, variant):
    def make():
        return sensor(model, **VARIANTS[variant])

    figures = make().adjustable
    assert set(ADJUSTABLE) - set(figures) <= {"leak_hz" if variant == "leak course" else "", "source_follower_hz"}
    for name, figure in figures.items():
        for ratio in RATIOS:
            assert_nothing_is_missed(make, {CHANGED_AT: [(name, figure * ratio or 20.0)]})


@pytest.mark.parametrize("begin_ms", [0, int(EPOCH_MS) - 80])
def test_changes_that_follow_each_other_act_on_pixels_that_rest(begin_ms):
    changes = {
        40: [("threshold_on", 0.15)],
        50: [("threshold_off", 0.1), ("refractory_us", 900.0)],
        60: [("leak_hz", 50.0)],
        70: [("highpass_hz", 8.0)],
        90: [("threshold_on", 0.5), ("source_follower_hz", 20.0)],
        95: [("highpass_hz", 0.0)],
        100: [("corner_max_hz", 50.0), ("leak_hz", 0.0)],
    }
    assert len(assert_nothing_is_missed(lambda: sensor("davis346"), changes, begin_ms)) > 1000


def test_a_lower_threshold_fires_resting_pixels_at_once():
    """Without leak and noise, each pixel fires once whose level lies between the new threshold and the old one."""
    one = sensor("davis346", leak_hz=0.0, parasitic_hz_at_reference=0.0, noise=NoiseParameters())
    found = events(one, {CHANGED_AT: [("threshold_on", 0.1)]}, full=False)
    assert set(found["t"] // 1000) == {CHANGED_AT - 1}
    assert found["on"].all()
    share = 1 - (0.1 + np.log(1.15)) / 0.283  # levels lie evenly from -ln 1.15, in the dark from 0, to 0.283 more
    in_dark = 1 - 0.1 / 0.283
    assert len(found) == pytest.approx(LIT * (share + in_dark), rel=0.05)


@pytest.mark.parametrize(
    "changes",
    [{"noise": NoiseParameters(rms=0.05, grade="grid")}, {"photoreceptor": "circuit", "noise": NoiseParameters()}],
)
def test_a_sensor_that_cannot_change_refuses(changes):
    one = sensor("davis346", **changes)
    assert one.adjustable == {}
    for name in ADJUSTABLE:
        with pytest.raises(ValueError, match=name):
            one.adjust(name, 1.0)
