"""The photoreceptor's circuit against scipy's Radau method, and what the circuit is known for."""

import dataclasses
import math

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.crossings import joined
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.methods.circuit import CircuitPixels

MS = 1_000_000
P = SensorParameters(
    width=1, height=1, threshold_on=0.25, threshold_off=0.25, mismatch=0.0, leak_hz=0.0, source_follower_hz=286.0,
    random_start=False, photoreceptor="circuit",
)  # fmt: skip
DARK = P.dark_current_relative


def truth(log_light, end_s, p=P, tolerance=1e-10):
    """Times and polarities of the events, by Radau with dense output and event location; no refractory period."""
    a, b, c = (2 * math.pi * hz for hz in (p.corner_hz_at_reference, p.corner_max_hz, p.source_follower_hz))

    def circuit(t, x):
        dy = b * (1 - math.exp(x[0]))
        return [a * (math.exp(x[1] - x[0]) - math.exp(log_light(t))) + dy, dy, c * (x[1] - x[2])]

    found, reference, t0, x = [], log_light(0.0), 0.0, [0.0, log_light(0.0), log_light(0.0)]
    while True:
        meets = [
            lambda t, x, r=reference: x[2] - r - p.threshold_on,
            lambda t, x, r=reference: x[2] - r + p.threshold_off,
        ]
        for one, direction in zip(meets, (1, -1), strict=True):
            one.terminal, one.direction = True, direction
        way = solve_ivp(
            circuit, (t0, end_s), x, "Radau", events=meets, rtol=tolerance, atol=1e-13, max_step=end_s / 200
        )
        if way.status != 1:
            return found
        on = way.t_events[0].size > 0
        t0, x = way.t[-1], way.y[:, -1]
        reference += p.threshold_on if on else -p.threshold_off
        found.append((t0, on))


def events(light, steps_ms, p=P, rate=None, make=CircuitPixels):
    pixels, parts, t_ns = make(p, 1), [], 0
    picture = lambda f, t: np.full((1, 1), f(t * 1e-9), np.float32)  # noqa: E731
    pixels.reset(LightFrame(0, picture(light, 0), None if rate is None else picture(rate, 0)))
    for step in steps_ms:
        t_ns += round(step * MS)
        parts.append(pixels.step(LightFrame(t_ns, picture(light, t_ns), None if rate is None else picture(rate, t_ns))))
    found = joined(parts)
    return list(zip(found.t_ns * 1e-9, found.on.tolist(), strict=True))


def ramp(before, after, over_s):
    """Light whose logarithm, with the dark current, goes straight from one level to another; and that logarithm."""
    u0, u1 = (math.log(level + DARK) for level in (before, after))
    log_light = lambda t: u0 + (u1 - u0) * min(t / over_s, 1)  # noqa: E731
    return (lambda t: math.exp(log_light(t)) - DARK), log_light


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize(("before", "after"), [(0.0, 1.0), (1.0, 0.0), (0.01, 0.1), (1.0, 0.5)])
def test_steps_of_light_have_the_events_of_a_fine_integration(before, after):
    light, log_light = ramp(before, after, 1e-3)
    found, expected = events(light, [1, *[4.0] * 30]), truth(log_light, 0.121)
    assert [on for _, on in found] == [on for _, on in expected]
    assert len(expected) >= 2
    off_us = 1e6 * np.abs(np.array([t for t, _ in found]) - [t for t, _ in expected])
    # float32 light is known to 1e-7 of itself, and a slow end of the answer makes much of it
    assert np.median(off_us) < 0.1
    assert off_us.max() < 5.0


def test_a_sine_with_its_derivative_is_of_fourth_order_in_the_frames():
    w = 2 * math.pi * 20
    light = lambda t: 0.3 * math.exp(0.9 * math.sin(w * t))  # noqa: E731
    rate = lambda t: light(t) * 0.9 * w * math.cos(w * t)  # noqa: E731
    expected = truth(lambda t: math.log(light(t) + DARK), 0.1, tolerance=1e-9)
    errors = []
    for step in (2.0, 1.0):
        found = events(light, [step] * round(100 / step), rate=rate)
        assert [on for _, on in found] == [on for _, on in expected]
        errors.append(np.median(np.abs(np.array([t for t, _ in found]) - [t for t, _ in expected])))
    assert errors[1] < 1e-6
    assert errors[0] < 40 * max(errors[1], 2e-8)


def test_the_output_rises_no_faster_than_its_slew():
    p = dataclasses.replace(P, source_follower_hz=0.0)
    light, _ = ramp(0.0, 100.0, 1e-6)
    found = events(light, [0.001, 5.0], p)
    times = np.array([t for t, on in found if on])
    assert times.size > 30
    assert np.diff(times).min() > 0.999 * 0.25 / (2 * math.pi * 3000)


def test_for_small_signals_it_is_the_low_pass_of_the_other_pixels():
    p = dataclasses.replace(P, threshold_on=0.002, threshold_off=0.002, corner_max_hz=1e5, corner_hz_at_reference=300.0)
    one_pole = dataclasses.replace(p, photoreceptor="one_pole")
    light, _ = ramp(0.5, 0.51, 1e-3)
    here, there = events(light, [1, *[4.0] * 10], p), events(light, [1, *[4.0] * 10], one_pole, make=PixelArray)
    assert len(here) == len(there) == 9
    assert [t for t, _ in here] == pytest.approx([t for t, _ in there], abs=20e-6)  # 1 / (2 pi 100 kHz), and 2 % of it


def test_still_light_leaks_at_its_rate_and_a_sensor_uses_it():
    p = dataclasses.replace(
        P, width=16, height=12, leak_hz=10.0, leak_spread=0.0, random_start=True, refractory_us=10.0
    )
    sensor, light = Sensor(p, 1), np.full((12, 16), 0.2, np.float32)
    sensor.reset(LightFrame(0, light))
    found = np.concatenate([sensor.expose(LightFrame(k * 100 * MS, light)) for k in range(1, 21)])
    assert isinstance(sensor.pixels, CircuitPixels)
    assert len(found) == pytest.approx(2 * 10 * 192, abs=192)
    assert found["on"].all()


def test_what_it_cannot_do_is_refused():
    with pytest.raises(ValueError, match="needs a finite corner"):
        dataclasses.replace(P, corner_hz_at_reference=math.inf)
    with pytest.raises(ValueError, match="photoreceptor = 'two_poles'"):
        dataclasses.replace(P, photoreceptor="two_poles")
    pixels = CircuitPixels(P, 1)
    pixels.reset(LightFrame(100, np.ones((1, 1), np.float32)))
    with pytest.raises(ValueError, match="time does not go back"):
        pixels.step(LightFrame(99, np.ones((1, 1), np.float32)))
