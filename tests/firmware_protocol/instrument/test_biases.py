"""Biases that telecommands set: whose numbers they are, what they do to the sensor, and what is refused."""

import math

import pytest

from firmware_protocol.davis346.biases import BIASES as DAVIS_BIASES
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import DavisBiases, Imx636Biases
from firmware_protocol.packets.telecommands import SetBias
from firmware_protocol.prophesee.biases import BiasModel

FACTORY = {0: 0x7C, 1: 0x53, 3: 0, 4: 0x66, 5: 0x4D, 6: 0x49, 7: 0x5B, 8: 0x14, 16: 0x8C, 17: 0x7C, 18: 0x94}


def test_numbers_of_an_imx636_are_those_of_its_registers():
    values = Imx636Biases(BiasModel()).values
    assert {number: values[number] for number in FACTORY} == FACTORY


def test_an_imx636_follows_by_its_slopes_and_tells_what_has_no_effect():
    biases = Imx636Biases(BiasModel())
    assert (biases.factors, biases.without_effect) == ({}, {})
    biases.set(4, 0x66 + 50)
    biases.set(3, 1)
    assert biases.factors == {"threshold_on": pytest.approx(math.exp(50 * 0.0143)), "highpass_hz": 1.0}
    biases.set(5, 0)
    assert list(biases.without_effect) == ["diff"]


@pytest.mark.parametrize(("number", "value"), [(2, 10), (9, 10), (35, 10), (4, 256), (4, 65535)])
def test_numbers_and_values_that_an_imx636_does_not_have_are_refused(number, value):
    biases = Imx636Biases(BiasModel())
    with pytest.raises(ValueError, match=f"bias {number}"):
        biases.set(number, value)
    assert (biases.factors, biases.without_effect) == ({}, {})


@pytest.mark.parametrize("biases", [DavisBiases(), Imx636Biases(BiasModel())])
def test_a_telecommand_moves_the_sensor(biases):
    instrument = Instrument((640, 480), biases=biases)
    number, value = (8, 40) if isinstance(biases, Imx636Biases) else (_address("RefrBp"), 0)
    assert instrument.sensor_factors == {}
    instrument.execute(SetBias(number, value))
    assert instrument.sensor_factors["refractory_us"] == pytest.approx(0.5 if number == 8 else 1000.0)
    assert instrument.biases[number] == value


def _address(name):
    return next(bias.address for bias in DAVIS_BIASES if bias.name == name)
