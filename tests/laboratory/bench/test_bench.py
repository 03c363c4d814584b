"""That the benches compare what they say: loads of noise have their rate, and scenes alike about as many events."""

import dataclasses

import numpy as np
import pytest

from emulator.light import LightFrame
from emulator.sensor.pixels.array import PixelArray
from laboratory.bench import links
from laboratory.bench import scenes as scenes_alike
from laboratory.bench.measures import MEASURES
from laboratory.bench.pixels import noisy_sensor
from laboratory.bench.scenes import ScenesAlike
from laboratory.bench.streams import BenchFailed
from laboratory.verbs.bench import bench


@pytest.mark.sampled
@pytest.mark.parametrize("events_hz", [1.0, 0.1, 10.0])
def test_a_load_of_noise_has_its_rate(events_hz):
    p = noisy_sensor(events_hz)
    p = dataclasses.replace(p, leak_hz=0.0, noise=dataclasses.replace(p.noise, history_s=200.0))
    pixels, light = PixelArray(p, 1), np.full((p.height, p.width), 0.05, np.float32)
    pixels.reset(LightFrame(0, light))
    found = sum(len(pixels.step(LightFrame(round((k + 1) * 1e8), light))) for k in range(10))
    assert found / light.size == pytest.approx(events_hz, rel=0.35)


@pytest.mark.system
def test_scenes_alike_have_as_many_events(monkeypatch):
    events = 1024
    monkeypatch.setattr(scenes_alike, "_STEPS", 30)
    found = {name: number for name, (_, number) in ScenesAlike(events).times().items()}
    assert found["grating"] == pytest.approx(events, rel=0.5)
    assert all(number == pytest.approx(events, rel=0.35) for name, number in found.items() if name != "grating")
    assert ScenesAlike(events)() >= 1


def test_a_pattern_selects_all_that_match(monkeypatch, capsys):
    few = [measure for measure in MEASURES if measure.name.startswith(("gpu_", "words"))]
    monkeypatch.setattr("laboratory.verbs.bench.MEASURES", few)
    monkeypatch.setattr("laboratory.verbs.bench._value", lambda measure: 1.0)
    assert bench(only=["gpu_*", "words_encode"]) == 0
    printed = capsys.readouterr().out
    assert printed.count("gpu_frame_") == 2
    assert "words_encode" in printed
    assert "words_decode" not in printed


@pytest.mark.system
@pytest.mark.parametrize("form", ["evt3", "aedat4"])
def test_a_file_has_a_speed_only_where_it_holds_every_event(form, monkeypatch):
    monkeypatch.setattr(links, "_FILE_EVENTS", 100_000)
    measure, read = links.FileEvents(form), links.read_events
    assert measure() > 0
    monkeypatch.setattr(links, "read_events", lambda path: read(path)[:-1])
    with pytest.raises(BenchFailed, match="of 100000 events the file holds 99999"):
        measure()
