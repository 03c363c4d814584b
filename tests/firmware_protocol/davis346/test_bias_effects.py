"""What bias words do to the pixels: by hand from the currents, at the ends of the range, and through the camera."""

import math

import pytest
from davis_host import Host

from firmware_protocol.davis346.biases import BIASES, CoarseFine, sensor_factors
from firmware_protocol.davis346.device import Davis346
from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR
from firmware_protocol.fx3.registers import Module

ADDRESSES = {bias.name: bias.address for bias in BIASES}
DEFAULTS = {bias.address: int(bias.default) for bias in BIASES}
ON_A, DIFF_A = 387.5e-9 / 255, 48.437e-9 * 39 / 255
NONE = dict.fromkeys(("threshold_on", "threshold_off", "refractory_us", "corner_max_hz", "source_follower_hz"), 1.0)


def with_word(name, word):
    return {**DEFAULTS, ADDRESSES[name]: int(word)}


def test_default_words_change_nothing():
    assert sensor_factors(DEFAULTS) == NONE


@pytest.mark.parametrize(
    ("name", "value", "figure", "factor"),
    [
        ("OnBn", CoarseFine(5, 128), "threshold_on", math.log(ON_A * 128 / DIFF_A) / math.log(ON_A * 255 / DIFF_A)),
        ("OffBn", CoarseFine(4, 4), "threshold_off", math.log(39 / 4) / math.log(39)),
        ("RefrBp", CoarseFine(4, 50, n_type=False), "refractory_us", 0.5),
        ("PrBp", CoarseFine(2, 116, n_type=False), "corner_max_hz", 2.0),
        ("PrSFBp", CoarseFine(1, 8, n_type=False), "source_follower_hz", 0.5),
    ],
)  # fmt: skip
def test_a_word_moves_its_figure_alone(name, value, figure, factor):
    assert sensor_factors(with_word(name, value)) == pytest.approx({**NONE, figure: factor})


def test_the_reference_current_moves_both_thresholds_apart():
    factors = sensor_factors(with_word("DiffBn", CoarseFine(4, 78)))
    assert factors["threshold_on"] < 1 < factors["threshold_off"]


@pytest.mark.parametrize("word", [0, 0xFFFF, 0x000F, 0x7FF0])
@pytest.mark.parametrize("name", ["OnBn", "OffBn", "DiffBn", "RefrBp", "PrBp", "PrSFBp"])
def test_any_word_gives_factors_within_the_range(name, word):
    for factor in sensor_factors(with_word(name, word)).values():
        assert LEAST_FACTOR <= factor <= MOST_FACTOR


def test_the_camera_tells_what_its_host_wrote():
    camera = Davis346()
    host = Host(camera)
    assert camera.sensor_factors == {}
    host.write_all([(int(Module.BIAS), ADDRESSES["PrBp"], int(CoarseFine(2, 29, n_type=False)))])
    assert camera.sensor_factors["corner_max_hz"] == pytest.approx(0.5)
    camera.attached()
    assert camera.sensor_factors == {}
