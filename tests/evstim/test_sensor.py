"""The sensor facade: the events of the simulation, and messages for arguments that are not light."""

import dataclasses
import typing
from collections.abc import Mapping
from typing import Any

import numpy as np
import pytest

import evstim

SMALL = {"width": 8, "height": 6, "mismatch": 0.0, "leak_hz": 0.0, "corner_hz_at_reference": float("inf"),
         "source_follower_hz": 0.0, "parasitic_hz_at_reference": 0.0, "noise": {"rms": 0.0}}  # fmt: skip
SMALL["corner_max_hz"] = float("inf")
DARK = np.full((6, 8), 0.1)


def small(**parameters):
    return evstim.Sensor("davis346", seed=1, **{**SMALL, **parameters})


def test_a_step_of_light_has_the_events_of_its_logarithm():
    sensor = small(threshold_on=0.2, refractory_us=0.0, dark_current_relative=1e-9)
    sensor.reset(DARK, 0)
    bright = DARK.copy()
    bright[2, 5] = 0.1 * np.exp(0.2 * 5.5)
    events = np.concatenate([sensor.expose(bright, 10_000_000), sensor.finish()])
    assert events.dtype == evstim.EVENT
    assert events["on"].all()
    assert set(events["x"]) == {5}
    assert set(events["y"]) == {2}
    # ln I grows by 1.1 in 10 ms on a straight line: a threshold of 0.2 is crossed every 2 / 1.1 ms.
    assert len(events) in (5, 6)
    np.testing.assert_allclose(np.diff(events["t"].astype(float)), 2000 / 1.1, atol=2)


def test_counts_balance_and_a_seed_repeats():
    def events_of(seed):
        sensor = evstim.Sensor("davis346", seed=seed, width=8, height=6)
        sensor.reset(DARK, 0)
        parts = [sensor.expose(DARK * k, k * 1_000_000) for k in range(2, 6)]
        assert sensor.raised == sensor.lost_in_pixel + sensor.lost_at_readout + sensor.read_out + sensor.pending
        return np.concatenate([*parts, sensor.finish()])

    assert np.array_equal(events_of(3), events_of(3))
    assert not np.array_equal(events_of(3), events_of(4))


def test_a_known_rate_bends_the_way_between_two_pictures():
    straight, bent = small(), small()
    for sensor in (straight, bent):
        sensor.reset(DARK, 0)
    t = [sensor.expose(DARK * 4, 10_000_000, rate)["t"] for sensor, rate in ((straight, None), (bent, DARK * 0))]
    assert t[0].size
    assert not np.array_equal(*t)


def test_parameters_go_over_the_preset_part_by_part():
    sensor = evstim.Sensor("dvxplorer_micro", threshold_on=0.4, noise={"rms": 0.01}, readout={"event_ns": 5.0})
    preset = evstim.PRESETS["dvxplorer_micro"]
    assert sensor.size == (640, 480)
    assert sensor.parameters.threshold_on == 0.4
    assert sensor.parameters.threshold_off == preset.threshold_off
    assert sensor.parameters.noise == dataclasses.replace(preset.noise, rms=0.01)
    assert sensor.parameters.readout == dataclasses.replace(preset.readout, event_ns=5.0)
    again = evstim.Sensor(sensor.parameters, width=10)
    assert again.parameters == dataclasses.replace(sensor.parameters, width=10)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"model": "davis364"}, "sensor 'davis364' is not known here; did you mean 'davis346'"),
        ({"treshold_on": 0.2}, "'treshold_on' is not known here; did you mean 'threshold_on'"),
        ({"threshold_on": -1.0}, "threshold_on"),
        ({"threshold_on": "much"}, "threshold_on"),
        ({"noise": {"rsm": 1.0}}, "noise.rsm.*did you mean 'rms'"),
        ({"width": 0}, "width"),
        ({"seed": -1}, "seed is -1"),
    ],
)
def test_a_wrong_parameter_is_named(arguments, message):
    with pytest.raises(ValueError, match=message):
        evstim.Sensor(**arguments)


@pytest.mark.parametrize(
    ("light", "error", "message"),
    [
        (np.ones((8, 6)), ValueError, r"shape \(8, 6\).*\(6, 8\)"),
        (np.ones((6, 8, 3)), ValueError, r"shape \(6, 8, 3\)"),
        (np.ones((6, 8), np.uint8), TypeError, "uint8.*events_from_frames"),
        (np.ones((6, 8), complex), TypeError, "complex"),
        (np.where(np.arange(48).reshape(6, 8) == 10, np.nan, 1.0), ValueError, "nan at x = 2, y = 1"),
        (np.full((6, 8), 1e300), ValueError, "must be finite"),
        (np.where(np.arange(48).reshape(6, 8) == 10, -0.5, 1.0), ValueError, "-0.5 at x = 2, y = 1"),
        ("light", TypeError, "light is an array of <U5"),
    ],
)
def test_what_is_not_light_is_refused(light, error, message):
    sensor = small()
    with pytest.raises(error, match=message):
        sensor.reset(light, 0)
    sensor.reset(DARK, 0)
    with pytest.raises(error, match=message):
        sensor.expose(light, 1000)
    assert not len(sensor.expose(DARK, 1000)), "what was refused has left no trace"


def test_time_goes_on():
    sensor = small()
    with pytest.raises(RuntimeError, match="call reset"):
        sensor.expose(DARK, 1)
    with pytest.raises(RuntimeError, match="call reset"):
        sensor.finish()
    with pytest.raises(ValueError, match="t_ns is -1"):
        sensor.reset(DARK, -1)
    with pytest.raises(ValueError, match="0 to 2"):
        sensor.reset(DARK, 1 << 70)
    sensor.reset(DARK, 5_000)
    for t_ns in (4_999, 5_000):
        with pytest.raises(ValueError, match=f"t_ns is {t_ns}: it must be later than the frame before, 5000 ns"):
            sensor.expose(DARK, t_ns)
    with pytest.raises(TypeError, match="whole nanoseconds"):
        sensor.expose(DARK, 1e6)
    sensor.expose(DARK, np.int64(6_000))
    sensor.finish()
    with pytest.raises(RuntimeError, match="call reset"):
        sensor.expose(DARK, 7_000)
    sensor.reset(DARK, 0)


def test_a_rate_may_be_negative_but_not_nan():
    sensor = small()
    sensor.reset(DARK, 0)
    sensor.expose(DARK, 1000, -DARK)
    with pytest.raises(ValueError, match="rate is nan"):
        sensor.expose(DARK, 2000, DARK * np.nan)


def test_the_options_are_the_fields_of_the_parameters():
    options, fields = (typing.get_type_hints(cls) for cls in (evstim.SensorOptions, evstim.SensorParameters))
    assert list(options) == list(fields)
    for name, annotation in fields.items():
        is_part = dataclasses.is_dataclass(annotation)
        assert options[name] == (annotation | Mapping[str, Any] if is_part else annotation), name
