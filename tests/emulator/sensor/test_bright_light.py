"""Light so bright that its parasitic leak crosses thresholds more often than anyone can list: counted, not followed."""

import dataclasses
import time

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.parameters import ComparatorParameters, NoiseParameters, ResetParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from laboratory.accuracy.peers.pangu import Pangu
from laboratory.methods.circuit import CircuitPixels
from laboratory.methods.grid import NoisyPixels, grid_ns

MS = 1_000_000
WIDTH, HEIGHT = 6, 4
PIXELS = WIDTH * HEIGHT
PLAIN = dataclasses.replace(
    PRESETS["davis346"], width=WIDTH, height=HEIGHT, refractory_us=0.0, noise=NoiseParameters(), leak_hz=0.0,
    mismatch=0.0,
)  # fmt: skip
METHODS = {
    "array": (PixelArray, PLAIN),
    "array without second pole": (PixelArray, dataclasses.replace(PLAIN, source_follower_hz=0.0)),
    "grid": (NoisyPixels, dataclasses.replace(PLAIN, noise=NoiseParameters(0.02, 300.0, "grid"))),
    "large signal": (PixelArray, dataclasses.replace(PLAIN, photoreceptor="large_signal")),
    "circuit": (CircuitPixels, dataclasses.replace(PLAIN, photoreceptor="circuit")),
    "pangu": (Pangu, PLAIN),
}


def still(value):
    return np.full((HEIGHT, WIDTH), value, np.float32)


@pytest.mark.sampled
@pytest.mark.parametrize("light", [1e9, 1e12, 1e30, np.finfo(np.float32).max])
@pytest.mark.parametrize("method", METHODS)
def test_a_step_ends_and_its_crossings_are_the_leak_times_the_light(method, light):
    make, parameters = METHODS[method]
    pixels = make(parameters, 1)
    pixels.reset(LightFrame(0, still(light)))
    pixels.step(LightFrame(MS, still(light)))
    before = pixels.lost_in_pixel
    listed = sum(len(pixels.step(LightFrame(k * MS, still(light)))) for k in range(2, 6))
    crossings = PIXELS * 4e-3 * parameters.parasitic_hz_at_reference * light
    most = 64 if method != "grid" else 16 * 2 * MS // grid_ns(parameters)  # of a pixel in a step
    assert listed <= 4 * most * PIXELS
    if light <= 1e12:
        assert listed + pixels.lost_in_pixel - before == pytest.approx(crossings, rel=0.02)
    else:
        assert listed + pixels.lost_in_pixel - before >= 4 * PIXELS * 2**32


@pytest.mark.sampled
@pytest.mark.parametrize("method", ["array", "array without second pole", "grid", "large signal", "circuit"])
@pytest.mark.parametrize("bright", [1e7, 1e30, np.inf])
def test_a_pixel_that_a_flash_has_left_sees_as_before(method, bright):
    """Half of the pixels see a flash of 2 ms; 200 ms later all see light double, in the dark of no leak to speak of."""
    make, parameters = METHODS[method]
    pixels = make(dataclasses.replace(parameters, parasitic_hz_at_reference=0.01, random_start=False), 1)
    flash = still(0.5)
    flash[:, ::2] = bright
    pixels.reset(LightFrame(0, still(0.5)))
    for t_ms, light in ((1, still(0.5)), (2, flash), (4, flash), (5, still(0.5)), (205, still(0.5)), (206, still(1.0))):
        pixels.step(LightFrame(t_ms * MS, light))
    later = [pixels.step(LightFrame(t_ms * MS, still(4.0))) for t_ms in range(207, 260)]
    counted = sum(np.bincount(one.pixel, minlength=PIXELS) for one in later).reshape(HEIGHT, WIDTH)
    assert np.abs(counted - np.log(4.0) / 0.283).max() <= 1.5
    assert all(one.on.all() for one in later)


@pytest.mark.parametrize("step_ms", [20, 200])
def test_a_leak_of_the_highest_rate_is_counted_in_long_steps(step_ms):
    pixels = PixelArray(dataclasses.replace(PLAIN, leak_hz=1e4, leak_spread=0.0), 1)
    pixels.reset(LightFrame(0, still(1.0)))
    listed = sum(len(pixels.step(LightFrame(k * step_ms * MS, still(1.0)))) for k in range(1, 11))
    assert listed == 10 * 64 * PIXELS
    assert listed + pixels.lost_in_pixel == pytest.approx(PIXELS * 100 * step_ms, rel=1e-3)


def waiting(refractory_us, **changes):
    return dataclasses.replace(PLAIN, refractory_us=refractory_us, **changes)


def raised_by(parameters, lights, step_ns):
    """Return the crossings of pixel 0, and of all, on light that changes along straight lines in its logarithm."""
    pixels = PixelArray(parameters, 1)
    pixels.reset(LightFrame(0, still(lights[0])))
    found = [pixels.step(LightFrame(k * step_ns, still(light))) for k, light in enumerate(lights[1:], 1)]
    return found, sum(map(len, found)) + pixels.lost_in_pixel


@pytest.mark.parametrize("leak_hz", [0.0, 1e4])
@pytest.mark.parametrize("light", [10.0, 1e3, 1e6, 1e12, 1e30])
def test_a_refractory_period_adds_to_the_period_of_the_leak(light, leak_hz):
    """Ten steps have the crossings of one stretch of time: the state of the pixel is carried across their ends."""
    parameters = waiting(1.0, parasitic_hz_at_reference=1e4, leak_hz=leak_hz, leak_spread=0.0, random_start=False)
    found, raised = raised_by(parameters, [light] * 11, 20 * MS)
    period_s = 1 / (1e4 * (light + parameters.dark_current_relative) + leak_hz) + 1e-6
    assert sum(map(len, found)) == 10 * 64 * PIXELS
    assert raised == pytest.approx(PIXELS * 0.2 / period_s, rel=2e-4)


@pytest.mark.parametrize("changes", [{}, {"reset": ResetParameters(offset=0.1)}, {"photoreceptor": "large_signal"},
                                     {"comparator": ComparatorParameters(3.0, 3.0)}])  # fmt: skip
def test_a_long_step_has_the_crossings_of_short_ones_that_follow_each(changes):
    """Light that rises by 4 and falls again, where each event is listed in steps of 0.1 ms, and few in those of 20."""
    parameters = waiting(5.0, parasitic_hz_at_reference=1e4, random_start=False, **changes)
    ramp = np.geomspace(5.0, 20.0, 201)
    ramp = np.concatenate([ramp, ramp[-2::-1]])
    found, raised = raised_by(parameters, ramp, MS // 10)
    _, raised_in_long = raised_by(parameters, ramp[::200], 20 * MS)
    assert sum(map(len, found)) == raised
    assert raised_in_long == pytest.approx(raised, rel=1e-3)


def test_the_time_of_a_step_does_not_grow_with_the_crossings_that_are_only_counted():
    parameters = waiting(0.001, parasitic_hz_at_reference=1e4)
    raised_by(parameters, [1e9] * 3, 1000)
    start_s = time.process_time()
    _, raised = raised_by(parameters, [1e9] * 3, 100 * MS)
    assert raised == pytest.approx(PIXELS * 0.2e9, rel=0.01)
    assert time.process_time() - start_s < 5.0


def test_the_sums_of_a_sensor_hold_under_such_light():
    sensor = Sensor(PLAIN, 1)
    sensor.reset(LightFrame(0, still(1.0)))
    for k, light in enumerate((1.0, 1e30, 1e30, np.inf, 1e12, 0.0, 1.0, 1.0), 1):
        sensor.expose(LightFrame(k * MS, still(light), np.zeros((HEIGHT, WIDTH), np.float32)))
    sensor.finish()
    assert sensor.raised == sensor.lost_in_pixel + sensor.lost_at_readout + sensor.read_out
    assert sensor.lost_in_pixel > 2**32
