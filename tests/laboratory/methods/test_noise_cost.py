"""The benchmark of the cost of noise: its light, its refusals, and its times beside a stand-in for OpenEB."""

import dataclasses
import itertools
import json
import sys

import numpy as np
import pytest

from laboratory.benchmarks import noise_cost
from laboratory.benchmarks.noise_cost import Beside, beside, frames, openeb, parameters, started, stepped

STAND_IN = """
import time
import numpy as np

class EventSimulator:
    event_maker = type("Buffer", (), {})()

    def __init__(self, height, width, on, off, *everything):
        assert (height, width, everything) == (260, 346, (500, 0.01, 286, 0.1, 1))

    def image_callback(self, light, t_us):
        assert light.shape == (260, 346) and light.max() <= 255
        end_s = time.process_time() + 0.2
        while time.process_time() < end_s:
            pass

    def get_events(self):
        return np.zeros(7, [(name, int) for name in "txyp"])
"""


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A checkout whose simulator takes 0.2 s of processor time a step and returns seven events."""
    package = tmp_path / "sdk/modules/core_ml/python/pypkg/metavision_core_ml"
    (package / "video_to_event").mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "video_to_event" / "simulator.py").write_text(STAND_IN)
    monkeypatch.setattr(sys, "path", [*sys.path])
    before = set(sys.modules)
    yield tmp_path
    for name in set(sys.modules) - before:
        if name.startswith("metavision"):
            del sys.modules[name]


@pytest.mark.parametrize("scene", ["grating", "edge"])
def test_rates_are_the_derivatives_of_the_light(scene):
    before, middle, after = itertools.islice(frames(scene, 1000), 9, 12)
    slope = (after.light.astype(np.float64) - before.light) / (2 * noise_cost.STEP_S)
    assert np.abs(middle.rate - slope).max() < 0.01 * np.abs(slope).max()
    assert middle.light.min() > 0
    assert middle.light.max() <= 1


def test_the_edge_crosses_nine_percent_of_the_columns():
    first, *_, last = (frame.light[0] for frame in frames("edge", 100))
    assert float((last - first).sum()) / 0.9 == pytest.approx(0.09 * 346, rel=0.02)


@pytest.mark.system
def test_both_simulators_get_all_steps(checkout, monkeypatch):
    monkeypatch.setattr(noise_cost, "FIRST_STEPS", 2)
    found = beside("edge", "ideal", str(checkout), 2)
    assert found.openeb_events == 7
    assert found.our_events > 0
    assert 0.2 <= found.openeb_s < 0.5
    assert 0 < found.ours_s < found.openeb_s


def test_a_line_has_the_ratio_of_the_times():
    line = str(Beside("edge", "imx636", True, 0.02, 0.005, 12.0, 34.0))
    assert line.startswith("edge     imx636    with noise: 4.5 Mpixel/s (12 events a step), OpenEB 18.0 (34)")
    assert line.endswith(": 0.25 times")


def test_a_folder_that_is_no_checkout_is_refused_with_the_way_to_get_one(tmp_path):
    with pytest.raises(SystemExit, match=r"git clone https://github\.com/prophesee-ai/openeb"):
        openeb(tmp_path)


def test_a_reset_is_measured_with_noise_and_without_after_a_first_one(monkeypatch):
    times_s, sensors = iter([0.5, 2.5, 2.0, 0.1, 0.25, 0.5]), []

    def seconds(reset):
        reset()
        sensors.append(reset.func.__self__.parameters.noise.rms > 0)
        return next(times_s)

    monkeypatch.setattr(noise_cost, "seconds", seconds)
    found = started("imx636", 0.1, (64, 48))
    assert sensors == [True] * 3 + [False] * 3
    assert str(found) == "imx636       light 0.1: 2.00 s, without noise 0.25 s"


def test_without_noise_the_rest_of_the_preset_stays():
    with_noise, without = (parameters("imx636", (64, 48), noise=noise) for noise in (True, False))
    assert without.noise.rms == 0 < with_noise.noise.rms
    assert dataclasses.replace(without, noise=with_noise.noise) == with_noise


def test_lines_come_as_json_too(checkout, monkeypatch, capsys):
    monkeypatch.setattr(noise_cost, "beside", lambda *a, noise: Beside(*a[:2], noise, 1.0, 2.0, 3.0, 4.0))
    openeb(checkout, steps=3, json=True)
    *lines, last = capsys.readouterr().out.splitlines()
    assert len(lines) == len(json.loads(last)) == 6
    assert [one["noise"] for one in json.loads(last)] == [True] * 4 + [False] * 2


def test_pixels_of_a_rig_are_those_of_the_preset_with_and_without_noise():
    found = stepped("rendezvous", (64, 48))
    assert found.events > found.events_without > 0  # the imx636 has noise events in the dark around the spacecraft
    line = str(found._replace(noise_s=0.02, without_s=0.004, events=1000.0, events_without=900.0))
    assert line == "rendezvous   20.0 ms a step (1000 events), without noise 4.0 ms (900)"
