"""Bounds of a sensor's numbers: the same in the schema, in rigs, in Python and for changes during a run."""

import dataclasses
import math

import numpy as np
import pytest

import evstim
from emulator.rig.top_level import rig_schema
from emulator.sensor import parameters
from emulator.sensor.parameters import BackgroundParameters, DefectParameters, JitterParameters, NoiseParameters
from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor, longest_step_ns
from firmware_protocol.bounds import bounds_of

SMALL = dataclasses.replace(
    PRESETS["dvxplorer_micro"], width=8, height=6, source_follower_hz=300.0, jitter=JitterParameters(latency_us=5.0)
)
TABLES = [SensorParameters, ReadoutParameters]
TABLES += [table for name, table in vars(parameters).items() if name.endswith("Parameters")]
NUMBERS = [(table, name) for table in TABLES for name in bounds_of(table)]


def beyond(bounds):
    """Return numbers outside of bounds."""
    low = bounds.gt if bounds.ge is None else math.nextafter(bounds.ge, -math.inf)
    return [math.nan, -1e30, low, *([] if bounds.le is None else [math.nextafter(bounds.le, math.inf), 1e30])]


def test_every_number_has_bounds():
    for table in TABLES:
        numbers = {f.name for f in dataclasses.fields(table) if f.type in ("int", "float")}
        assert numbers == set(), table


@pytest.mark.parametrize(("table", "name"), NUMBERS)
def test_a_number_beyond_its_bounds_is_refused_and_the_schema_has_them(table, name):
    bounds, schema = bounds_of(table)[name], rig_schema()["$defs"][table.__name__]["properties"][name]
    assert schema.get("minimum", schema.get("exclusiveMinimum")) == (bounds.gt if bounds.ge is None else bounds.ge)
    assert schema.get("maximum") == bounds.le
    needed = {"event_ns": 1.0, "row_ns": 0} if table is ReadoutParameters else {}
    made = PRESETS["ideal"] if table is SensorParameters else table(**needed)
    for value in beyond(bounds):
        with pytest.raises(ValueError, match=f"^{name} must be"):
            dataclasses.replace(made, **{name: value})


def test_a_value_beyond_its_bounds_is_refused_while_the_sensor_runs():
    sensor = Sensor(SMALL, 1)
    before = sensor.adjustable
    assert set(before) == {
        "threshold_on", "threshold_off", "leak_hz", "refractory_us", "corner_max_hz", "source_follower_hz", "scan_us",
        "off_latency_us", "highpass_hz",
    }  # fmt: skip
    tables = {"scan_us": ReadoutParameters, "off_latency_us": JitterParameters}
    for name in before:
        bounds = bounds_of(tables.get(name, SensorParameters))[name]
        for value in [*beyond(bounds), *([0.0] if name in tables else [])]:
            with pytest.raises(ValueError, match=name):
                sensor.adjust(name, value)
    assert sensor.adjustable == before


@pytest.mark.parametrize(
    ("noisy", "most_s"),
    [
        ({"leak_hz": 1e4}, 4e-3),
        ({"background": BackgroundParameters(hz=1e4)}, 4e-3),
        ({"defects": DefectParameters(hot_share=1.0, hot_hz=1e4)}, 4e-3),
        ({"noise": NoiseParameters(rms=1.0, corner_hz=1e6), "corner_max_hz": 1e6}, 5e-3),
        ({"noise": NoiseParameters(rms=0.05, grade="grid")}, 5e-3),
        ({"imager": parameters.ImagerParameters(photon_shot_noise=True, shot_grid_us=100)}, 0.1),
    ],
)
def test_the_longest_step_bounds_the_events_and_the_moves_of_a_step(noisy, most_s):
    silent = {"noise": NoiseParameters(), "background": BackgroundParameters(), "leak_hz": 0.0}
    quiet = dataclasses.replace(PRESETS["imx636"], **silent)
    assert longest_step_ns(quiet) > 10**12
    assert longest_step_ns(dataclasses.replace(quiet, **noisy)) <= most_s * 1e9


def test_presets_are_not_limited():
    for p in PRESETS.values():
        assert longest_step_ns(p) > 10**10


def test_a_change_during_a_run_changes_the_longest_step():
    sensor = Sensor(SMALL, 1)
    before = sensor.longest_step_ns
    sensor.adjust("leak_hz", 1e4)
    assert sensor.longest_step_ns < before / 10


def test_frames_too_far_apart_for_the_events_between_them_are_refused_in_python():
    sensor = evstim.Sensor(SMALL, leak_hz=1e4)
    sensor.reset(np.ones((6, 8)))
    with pytest.raises(ValueError, match="give frames more often"):
        sensor.expose(np.ones((6, 8)), 2**61)
