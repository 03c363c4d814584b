"""That the benches compare what they say: loads of noise have their rate, and scenes alike about as many events."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from laboratory.bench import scenes as scenes_alike
from laboratory.bench.measures import MEASURES
from laboratory.bench.pixels import NoiseLoad, NoiseShare, noisy_sensor
from laboratory.bench.scenes import Drawing, ScenesAlike
from laboratory.verbs.bench import bench


@pytest.mark.parametrize("events_hz", [1.0, 10.0])
def test_a_load_of_noise_has_about_its_rate(events_hz):
    """Its rate is planned by the law of still light, which holds within a factor of 1.3."""
    p = dataclasses.replace(noisy_sensor(events_hz), leak_hz=0.0, parasitic_hz_at_reference=0.0)
    pixels, light, seconds = PixelArray(p, 1), np.full((p.height, p.width), 0.05, np.float32), 5 / events_hz
    pixels.reset(LightFrame(0, light))
    found = pixels.step(LightFrame(round(seconds * 1e9), light))
    assert events_hz / 1.3 < len(found) / light.size / seconds < events_hz * 1.3


def test_a_load_takes_some_time(monkeypatch):
    for name, less in (("_NOISE_STEPS", 20), ("_BLOCKS", 3)):
        monkeypatch.setattr(f"laboratory.bench.pixels.{name}", less)
    for with_readout in (False, True):
        assert abs(NoiseLoad(10.0, with_readout)()) < 1e5  # a difference, which a busy machine may turn round
    assert 0 < NoiseShare(1.0)() < 1e3


@pytest.mark.system
@pytest.mark.parametrize("events", [64, 1024])
def test_scenes_alike_have_as_many_events(monkeypatch, events):
    monkeypatch.setattr(scenes_alike, "_STEPS", 30)
    found = {name: number for name, (_, number) in ScenesAlike(events).times().items()}
    assert found["grating"] == pytest.approx(events, rel=0.5)
    assert all(number == pytest.approx(events, rel=0.35) for name, number in found.items() if name != "grating")
    assert ScenesAlike(events)() >= 1


@pytest.mark.gl
@pytest.mark.usefixtures("gl")
def test_a_frame_drawn_by_gl_takes_some_time(monkeypatch):
    monkeypatch.setattr(scenes_alike, "_REPEAT_S", 0.01)
    assert 0 < Drawing((32, 24))() < 1e4


def test_a_pattern_selects_all_that_match(monkeypatch, capsys):
    few = [measure for measure in MEASURES if measure.name.startswith(("gpu_", "words"))]
    monkeypatch.setattr("laboratory.verbs.bench.MEASURES", few)
    monkeypatch.setattr("laboratory.verbs.bench._value", lambda measure: 1.0)
    assert bench(only=["gpu_*", "words_encode"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("gpu_frame_") == 2
    assert "words_encode" in printed
    assert "words_decode" not in printed
