"""Origins of events: the events stay those of the sensor, and where one thing alone can raise events, it did."""

import dataclasses
import math
from collections import Counter
from functools import partial

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.run.truth.origins import Origin, TracedSensor
from emulator.sensor.presets import PRESETS
from emulator.sensor.sensor import Sensor
from laboratory.accuracy.peers.pangu import Pangu

WIDTH, HEIGHT = 40, 30
IDEAL = dataclasses.replace(PRESETS["ideal"], width=WIDTH, height=HEIGHT)
MS = 1_000_000


def with_table(p, table, **changes):
    return dataclasses.replace(p, **{table: dataclasses.replace(getattr(p, table), **changes)})


EVERYTHING = dataclasses.replace(
    PRESETS["davis346"], width=WIDTH, height=HEIGHT, leak_hz=2.0, parasitic_hz_at_reference=1.0
)
EVERYTHING = with_table(EVERYTHING, "noise", rms=0.16)
EVERYTHING = with_table(EVERYTHING, "background", hz=2.0, pair_share=0.3)
EVERYTHING = with_table(EVERYTHING, "radiation", hits_per_cm2_s=3000.0)
EVERYTHING = with_table(EVERYTHING, "jitter", latency_us=80.0, deviation_us=30.0, leak_share=0.2)
EVERYTHING = with_table(EVERYTHING, "defects", hot_share=0.01, dead_share=0.01)
EVERYTHING = with_table(EVERYTHING, "reset", at_acknowledge=True)
COUNTED = with_table(EVERYTHING, "imager", photon_shot_noise=True)
COUNTED = with_table(COUNTED, "reset", offset=0.02, noise=0.01)
COUNTED = with_table(COUNTED, "comparator", on_us=1.0, off_us=200.0)
SCANNED = with_table(EVERYTHING, "readout", scan_us=200.0)
GRID = with_table(EVERYTHING, "noise", grade="grid")
FEW = dataclasses.replace(EVERYTHING, width=8, height=6)


def moving(k):
    light = np.full((HEIGHT, WIDTH), 0.05, np.float32)
    light[:, k % WIDTH : k % WIDTH + 6] *= 2
    return light


def events_of(sensor, light_of=moving, steps=80, step_ns=10 * MS):
    """Events and, of a traced sensor, their origins."""
    sensor.reset(LightFrame(0, light_of(0)))
    events, origins = [], []
    for k in range(1, steps):
        events.append(sensor.expose(LightFrame(k * step_ns, light_of(k))))
        origins.append(getattr(sensor, "origins", None))
    events.append(sensor.finish())
    origins.append(getattr(sensor, "origins", None))
    return np.concatenate(events), None if origins[0] is None else np.concatenate(origins)


def still(level):
    return lambda _: np.full((HEIGHT, WIDTH), level, np.float32)


@pytest.mark.sampled
@pytest.mark.parametrize("p", [EVERYTHING, COUNTED, SCANNED], ids=["everything", "counted photons", "scanned"])
def test_the_events_are_those_of_the_sensor(p):
    plain, _ = events_of(Sensor(p, 5))
    traced, origins = events_of(TracedSensor(p, 5))
    assert len(plain) > 3000
    assert (plain == traced).all()
    assert len(origins) == len(traced)
    assert set(np.unique(origins)) == set(Origin) - {Origin.UNKNOWN}


def test_a_sensor_starts_anew():
    sensor = TracedSensor(EVERYTHING, 5)
    first, origins = events_of(sensor)
    second, again = events_of(sensor)
    assert (first == second).all()
    assert (origins == again).all()


@pytest.mark.parametrize(
    ("changes", "origin"),
    [
        ({"leak_hz": 3.0}, Origin.LEAK),
        ({"parasitic_hz_at_reference": 30.0}, Origin.LEAK),
        ({"defects": dataclasses.replace(IDEAL.defects, hot_pixels=((3, 4), (5, 6)), hot_hz=40.0)}, Origin.LEAK),
        ({"leak_hz": 3.0, "random_start": True}, Origin.LEAK),
        ({"noise": dataclasses.replace(IDEAL.noise, rms=0.09, corner_hz=300.0)}, Origin.NOISE),
        ({"background": dataclasses.replace(IDEAL.background, hz=3.0)}, Origin.BACKGROUND),
        ({"radiation": dataclasses.replace(IDEAL.radiation, hits_per_cm2_s=3000.0)}, Origin.PARTICLE),
    ],
    ids=["leak", "parasitic leak", "hot pixels", "leak from random starts", "noise", "background", "particles"],
)
def test_in_still_light_all_events_have_the_one_origin_there_is(changes, origin):
    events, origins = events_of(TracedSensor(dataclasses.replace(IDEAL, **changes), 2), still(0.1))
    assert len(events) > 20
    assert set(origins) == {origin}


def test_without_leak_and_noise_all_events_are_the_signals():
    events, origins = events_of(TracedSensor(IDEAL, 2))
    assert len(events) > 3000
    assert set(origins) == {Origin.SIGNAL}


@pytest.mark.parametrize("latency_us", [0.0, 400.0])
def test_particles_are_the_events_that_a_chip_without_radiation_lacks(latency_us):
    """The read-out is infinitely fast and loses nothing, so events are a sum."""
    noisy = dataclasses.replace(IDEAL, leak_hz=2.0, background=dataclasses.replace(IDEAL.background, hz=2.0))
    noisy = with_table(noisy, "jitter", latency_us=latency_us, deviation_us=latency_us / 2)
    struck = with_table(noisy, "radiation", hits_per_cm2_s=20000.0)
    events, origins = events_of(TracedSensor(struck, 4))
    bare, _ = events_of(Sensor(noisy, 4))
    added = Counter(event.tobytes() for event in events) - Counter(event.tobytes() for event in bare)
    assert Counter(event.tobytes() for event in events[origins == Origin.PARTICLE]) == added
    assert len(added) > 50


@pytest.mark.parametrize("against", [0.7, 0.95, 1.05, 1.4])
def test_an_on_event_is_the_leaks_where_the_leak_has_moved_further_than_the_light(against):
    """Log light rises `against` times as fast as the leak moves the reference: at 1 the two are equal."""
    leak_hz, step_ns = 4.0, 2 * MS
    rate = against * leak_hz * IDEAL.threshold_on

    def light(k):
        return np.full((HEIGHT, WIDTH), 0.1 * math.exp(rate * k * step_ns * 1e-9), np.float32)

    p = dataclasses.replace(IDEAL, leak_hz=leak_hz, dark_current_relative=1e-9, random_start=True)
    events, origins = events_of(TracedSensor(p, 2), light, 400, step_ns)
    assert len(events) > 4 * WIDTH * HEIGHT
    assert set(origins) == {Origin.LEAK if against < 1 else Origin.SIGNAL}


def test_an_off_event_is_never_the_leaks():
    p = dataclasses.replace(IDEAL, leak_hz=4.0, dark_current_relative=1e-9)

    def falling(k):
        return np.full((HEIGHT, WIDTH), 0.5 * math.exp(-1.6 * k * 0.002), np.float32)

    events, origins = events_of(TracedSensor(p, 2), falling, 300, 2 * MS)
    assert not events["on"].any()
    assert len(events) > WIDTH * HEIGHT
    assert set(origins) == {Origin.SIGNAL}


def test_pixels_that_contain_their_noise_tell_nothing():
    p = dataclasses.replace(FEW, noise=GRID.noise, background=IDEAL.background, radiation=IDEAL.radiation)
    sensor = TracedSensor(p, 3)
    sensor.reset(LightFrame(0, np.full((6, 8), 0.05, np.float32)))
    assert len(sensor.expose(LightFrame(30 * MS, np.full((6, 8), 0.2, np.float32)))) > 20
    assert set(sensor.origins) == {Origin.UNKNOWN}


def test_the_rule_of_another_simulator_tells_nothing():
    events, origins = events_of(TracedSensor(IDEAL, 2, Pangu))
    assert len(events) > 1000
    assert set(origins) == {Origin.UNKNOWN}


def test_the_method_may_be_a_partial():
    from emulator.sensor.pixels.array import PixelArray

    one, _ = events_of(Sensor(EVERYTHING, 5, partial(PixelArray, threads=1)))
    other, _ = events_of(TracedSensor(EVERYTHING, 5, partial(PixelArray, threads=1)))
    assert (one == other).all()
