"""Sensor parameters: what is accepted, what is refused and how that is said; the presets' figures."""

import dataclasses
import math

import pytest

from emulator.sensor.presets import PRESETS, ReadoutParameters, SensorParameters

PLAIN = SensorParameters(width=4, height=3, threshold_on=0.2, threshold_off=0.2)


@pytest.mark.parametrize("name", ["davis346", "dvxplorer_micro", "imx636"])
def test_presets_are_there_and_plausible(name):
    p = PRESETS[name]
    assert 0.1 <= p.threshold_on <= 0.4
    assert 0.1 <= p.threshold_off <= 0.4
    assert 0.02 <= p.mismatch <= 0.1
    assert p.dark_current_relative > 0
    assert 0.05 <= p.leak_hz <= 0.2


def test_the_sizes_and_rates_of_the_presets():
    sizes = {name: (p.width, p.height) for name, p in PRESETS.items()}
    assert sizes == {"davis346": (346, 260), "dvxplorer_micro": (640, 480), "imx636": (1280, 720)}
    assert 1e3 / PRESETS["davis346"].readout.event_ns == pytest.approx(12, rel=0.05)  # Mev/s
    assert 1e3 / PRESETS["imx636"].readout.event_ns == pytest.approx(1066, rel=0.01)


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("width", 0), ("height", -1), ("width", 70_000),
        ("threshold_on", 0.0), ("threshold_on", -0.1), ("threshold_off", 0.0), ("threshold_off", math.nan),
        ("threshold_on", math.inf), ("mismatch", -0.01), ("mismatch", 0.5), ("mismatch", math.nan),
        ("dark_current_relative", 0.0), ("dark_current_relative", -1.0), ("dark_current_relative", math.inf),
        ("corner_hz_at_reference", 0.0), ("corner_hz_at_reference", math.nan), ("corner_min_hz", 0.0),
        ("corner_min_hz", math.inf), ("corner_max_hz", 1.0), ("leak_hz", -0.1), ("leak_hz", math.inf),
        ("leak_spread", -0.1), ("refractory_us", -1.0), ("refractory_us", math.nan), ("refractory_us", math.inf),
    ],
)  # fmt: skip
def test_what_makes_no_sense_is_refused_by_name_and_value(field, value):
    with pytest.raises(ValueError, match=f"{field} = .*must be"):
        dataclasses.replace(PLAIN, **{field: value})


@pytest.mark.parametrize(
    ("field", "value"),
    [("refractory_us", 0.0), ("leak_hz", 0.0), ("mismatch", 0.0), ("corner_hz_at_reference", math.inf),
     ("corner_max_hz", math.inf)],
)  # fmt: skip
def test_what_is_extreme_but_makes_sense_is_accepted(field, value):
    assert getattr(dataclasses.replace(PLAIN, **{field: value}), field) == value


@pytest.mark.parametrize(("event_ns", "row_ns"), [(0.0, 10), (-1.0, 10), (math.nan, 10), (80.0, -1), (math.inf, 10)])
def test_an_arbiter_needs_times(event_ns, row_ns):
    with pytest.raises(ValueError, match="_ns = "):
        ReadoutParameters(event_ns=event_ns, row_ns=row_ns)


def test_too_many_pixels_are_refused():
    with pytest.raises(ValueError, match="at most"):
        dataclasses.replace(PLAIN, width=65_536, height=65_536)
