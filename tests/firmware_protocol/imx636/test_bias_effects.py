"""What biases of the IMX636 do to its pixels: by hand from the slopes, at the ends, and the same for both cameras."""

import math
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR
from firmware_protocol.gige.control import Write
from firmware_protocol.imx636.evk4 import Evk4
from firmware_protocol.imx636.registers import BIASES
from firmware_protocol.imx636.triton2 import Triton2
from firmware_protocol.imx636.triton2_registers import BIASES as OFFSETS
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes

SLOPES = BiasSlopes(diff_on=0.01, diff_off=0.02, diff_off_above=0.015, fo=0.025, refr=0.04, hpf=1.5)


def test_the_factory_biases_change_nothing():
    assert BiasModel().factors(dict.fromkeys(BIASES, 0)) == {}
    assert BiasModel().without_effect(dict.fromkeys(BIASES, 0)) == {}


@pytest.mark.parametrize(
    ("bias", "steps", "figure", "factor"),
    [
        ("diff_on", 50, "threshold_on", math.exp(0.5)),
        ("diff_on", -50, "threshold_on", math.exp(-0.5)),
        ("diff_off", 60, "threshold_off", math.exp(0.9)),
        ("diff_off", 100, "threshold_off", math.e),  # no threshold rises more
        ("diff_off", -30, "threshold_off", math.exp(-0.6)),
        ("fo", 40, "corner_max_hz", 2.0),
        ("fo", -20, "corner_max_hz", 0.5),
        ("refr", 75, "refractory_us", 0.25),
        ("refr", -20, "refractory_us", 5.0),
        ("refr", -24, "refractory_us", 25.0),
        ("refr", -25, "refractory_us", 25.0),  # register 0 acts as 1
        ("diff_on", -250, "threshold_on", LEAST_FACTOR),
        ("hpf", 1, "highpass_hz", 1.5),  # a sum, not a factor
        ("hpf", 120, "highpass_hz", 180.0),
    ],
)
def test_a_bias_moves_its_figure_alone(bias, steps, figure, factor):
    assert BiasModel(SLOPES).factors({bias: steps}) == {figure: pytest.approx(factor)}


def test_the_longest_dead_time_is_that_of_the_least_current():
    factors = [BiasModel().factors({"refr": steps})["refractory_us"] for steps in (-18, -19, -20)]
    assert factors == [pytest.approx(10.0), pytest.approx(20.0), pytest.approx(20.0)]


def test_the_low_pass_is_the_source_follower_where_there_is_one():
    assert BiasModel(SLOPES, "source_follower_hz").factors({"fo": 40}) == {"source_follower_hz": pytest.approx(2.0)}


def test_the_delay_of_off_events_follows_diff_off_where_there_is_one():
    """Parts of NIST's latencies that do not depend on light, by straight lines: 222 us at diff_off 95, 1294 at 142."""
    model = BiasModel(has_delay=True)
    late = [model.factors({"diff_off": steps})["off_latency_us"] for steps in (95, 142)]
    assert late[1] / late[0] == pytest.approx(1294 / 222, rel=0.4)
    assert "off_latency_us" not in model.factors({"diff_on": 95})


def test_the_default_slopes_are_those_whose_source_is_named():
    defaults = BiasSlopes()
    assert 1 / defaults.fo == pytest.approx(BIASES["fo"][1], rel=0.01)
    assert 1 / defaults.refr == BIASES["refr"][1]
    # NIST's latencies over the factory's, from straight lines over 1 / light; the receptor's law is theta for ON events
    # and e^theta - 1 for OFF events
    for steps, ratio in ((-42, 0.66), (-21, 0.85), (35, 1.56), (70, 2.97), (105, 3.27)):
        assert BiasModel().factors({"diff_on": steps})["threshold_on"] == pytest.approx(ratio, rel=0.2)
    for steps, ratio in ((-25, 0.49), (-8, 0.80), (47, 1.77), (95, 3.8)):
        threshold = 0.223 * BiasModel().factors({"diff_off": steps})["threshold_off"]
        assert math.expm1(threshold) / math.expm1(0.223) == pytest.approx(ratio, rel=0.2)


def test_biases_without_effect_are_told_with_the_reason():
    told = BiasModel().without_effect({"hpf": -3, "diff": -1, "pr": 7, "diff_on": 5, "inv": 0})
    assert list(told) == ["diff", "hpf", "pr"]
    assert "factory" in told["hpf"]
    assert BiasModel().without_effect({"hpf": 3}) == {}


@given(st.dictionaries(st.sampled_from(sorted(BIASES)), st.integers(-255, 255)), st.floats(0, 1))
def test_any_registers_and_slopes_give_factors_within_the_range(steps, slope):
    model = BiasModel(BiasSlopes(*[slope] * 7), has_delay=True)
    factors = model.factors(steps)
    assert 0 < factors.pop("highpass_hz", 1.0) <= MOST_FACTOR
    assert all(LEAST_FACTOR <= factor <= MOST_FACTOR for factor in factors.values())


@pytest.mark.parametrize(
    "name", ["diff_on", "diff_off", "diff_off_above", "largest_exponent", "off_delay", "fo", "refr"]
)
@pytest.mark.parametrize("value", [-0.001, 1.001, float("nan"), float("inf")])
def test_slopes_that_cannot_be_are_refused_by_name(name, value):
    with pytest.raises(ValueError, match=f"^{name} must be 0 to 1"):
        BiasSlopes(**{name: value})


@pytest.mark.parametrize(
    ("name", "offset"), [("diff_on", -40), ("diff_off", 90), ("fo", 55), ("refr", 235), ("hpf", 9)]
)
def test_both_cameras_make_the_same_of_the_same_offset(name, offset):
    usb, ethernet = Evk4(), Triton2()
    address, factory = BIASES[name]
    usb.write_register(address, 0x11A1_0000 | factory + offset)
    (value,) = struct.unpack(">I", struct.pack(">i", offset))
    ethernet.obey(Write(OFFSETS[name].address, value))
    assert usb.sensor_factors == ethernet.sensor_factors
    assert usb.without_effect == ethernet.without_effect
    assert len(usb.sensor_factors) + len(usb.without_effect) == 1
