"""Each pixel method does what its capabilities state, and nothing else; all check their input alike."""

import copy
import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame, Region
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.method import ADJUSTABLE
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor, own_pixels
from laboratory.accuracy.peers.pangu import Pangu
from laboratory.methods.circuit import CircuitPixels
from laboratory.methods.grid import NoisyPixels

MS = 1_000_000
WIDTH, HEIGHT = 24, 16
PLAIN = SensorParameters(
    width=WIDTH,
    height=HEIGHT,
    threshold_on=0.2,
    threshold_off=0.2,
    mismatch=0.02,
    leak_hz=0.0,
    refractory_us=0.0,
    corner_hz_at_reference=300.0,
    corner_max_hz=3000.0,
    random_start=False,
)
NOISY = dataclasses.replace(PLAIN, noise=NoiseParameters(rms=0.002, grade="grid", corner_hz=500.0))
CIRCUIT = dataclasses.replace(PLAIN, photoreceptor="circuit")
METHODS = {
    "own": (PixelArray, PLAIN),
    "grid": (NoisyPixels, NOISY),
    "circuit": (CircuitPixels, CIRCUIT),
    "pangu": (Pangu, PLAIN),
}
ALL = pytest.mark.parametrize("method", METHODS)


def made(method, **changes):
    make, parameters = METHODS[method]
    return make(dataclasses.replace(parameters, **changes), 3)


def level(value):
    return np.full((HEIGHT, WIDTH), value, np.float32)


def crossings(pixels, frames):
    """Return the crossings of frames as a list of (t_ns, pixel, on)."""
    pixels.reset(frames[0])
    found = [copy.deepcopy(pixels.step(frame)) for frame in frames[1:]]
    return [one for c in found for one in zip(c.t_ns.tolist(), c.pixel.tolist(), c.on.tolist(), strict=True)]


def rising(rate=None, at=None):
    """Light that rises to three times itself within 4 ms, and stays."""
    ends = [1.0, 2.0, 3.0, *[3.0] * 5]
    return [
        LightFrame(2 * k * MS, level(value), rate if k else None, at if k else None) for k, value in enumerate(ends)
    ]


@ALL
def test_the_derivative_is_used_where_that_is_stated(method):
    without, steep = (crossings(made(method), rising(rate)) for rate in (None, level(400.0)))
    assert without
    assert (without != steep) == made(method).capabilities.uses_rate


@ALL
def test_single_pixels_are_requested_where_that_is_stated(method):
    requests = []

    def at(t_ns, pixels):
        requests.append(t_ns)
        return np.full(pixels.size, 1.5, np.float32), np.zeros(pixels.size, np.float32)

    assert crossings(made(method), rising(level(3000.0), at))
    assert bool(requests) == made(method).capabilities.refines_pixels


@ALL
def test_resting_pixels_outside_the_changed_region_are_skipped_where_that_is_stated(method):
    nothing = Region(0, 0, 0, 0)
    still = [LightFrame(k * 100 * MS, level(1.0), level(0.0), changed=nothing if k else None) for k in range(15)]
    later = [LightFrame((1500 + 10 * k) * MS, level(3.0), level(0.0), changed=nothing) for k in range(5)]
    pixels = made(method)
    assert bool(crossings(pixels, [*still, *later])) != pixels.capabilities.skips_unchanged


@ALL
def test_parameters_change_where_that_is_stated(method):
    pixels = made(method, source_follower_hz=300.0) if method != "circuit" else made(method)
    pixels.reset(LightFrame(0, level(1.0)))
    if not pixels.capabilities.is_adjustable:
        assert pixels.adjustable == {}
        with pytest.raises(NotImplementedError):
            pixels.adjust("threshold_on", 0.5)
        return
    assert set(pixels.adjustable) == set(ADJUSTABLE)
    everywhere = np.arange(WIDTH * HEIGHT)
    before = pixels.levels().thresholds(everywhere)
    pixels.adjust("threshold_on", 2 * pixels.parameters.threshold_on)
    on, off = pixels.levels().thresholds(everywhere)
    assert on == pytest.approx(2 * before[0])
    assert np.array_equal(off, before[1])


@ALL
def test_pixels_have_faults_where_that_is_stated(method):
    pixels, dead = made(method), np.array([5, 77])
    if not pixels.capabilities.has_faults:
        for act in (lambda: pixels.kill(dead), pixels.leak_hz, lambda: pixels.set_leak(np.zeros(WIDTH * HEIGHT))):
            with pytest.raises(NotImplementedError):
                act()
        return
    pixels.kill(dead)
    fired = {pixel for _, pixel, _ in crossings(pixels, rising())}
    assert fired == set(range(WIDTH * HEIGHT)) - set(dead.tolist())
    pixels.set_leak(np.full(WIDTH * HEIGHT, 2.0))
    assert pixels.leak_hz() == pytest.approx(2.0)


@ALL
def test_reads_of_rows_disturb_pixels_where_that_is_stated(method):
    pixels = made(method)
    if not pixels.capabilities.takes_row_reads:
        with pytest.raises(NotImplementedError):
            pixels.levels()
        return
    crossings(pixels, rising())
    on, _ = pixels.levels().thresholds(np.arange(WIDTH * HEIGHT))
    assert np.all(pixels.levels().of(np.arange(WIDTH * HEIGHT)) < on)


@ALL
@pytest.mark.parametrize(
    ("wrong", "words"),
    [
        (LightFrame(6 * MS, np.ones((3, 3), np.float32)), "must be"),
        (LightFrame(6 * MS, np.ones((HEIGHT, WIDTH))), "must be"),
        (LightFrame(6 * MS, np.ones((WIDTH, HEIGHT), np.float32)), "must be"),
        (LightFrame(4 * MS, np.ones((HEIGHT, WIDTH), np.float32)), "time does not go back"),
    ],
)
def test_wrong_frames_are_refused_alike(method, wrong, words):
    pixels = made(method)
    pixels.reset(LightFrame(0, level(1.0)))
    pixels.step(LightFrame(5 * MS, level(1.0)))
    with pytest.raises(ValueError, match=words):
        pixels.step(wrong)


def test_a_sensor_has_the_method_of_its_effects_unless_one_is_given():
    for method in ("own", "grid", "circuit"):
        make, parameters = METHODS[method]
        assert type(own_pixels(parameters, 1)) is make
        assert type(Sensor(parameters, 1).pixels) is make
    for parameters, words in ((NOISY, "noise.grade"), (CIRCUIT, "photoreceptor")):
        for make in (PixelArray, Pangu):
            with pytest.raises(ValueError, match=f"{words}.*is a method of its own"):
                Sensor(parameters, 1, make)
