"""The sensor's registers: power-on, instruments, gate, and addresses that are none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.imx636.biases import BiasModel, BiasSlopes
from firmware_protocol.imx636.registers import NoRegister, Registers, Surroundings


def test_the_thermometer_answers_when_it_is_started():
    registers = Registers(Surroundings(celsius=39.0))
    assert registers.read(0x0050) == 0
    registers.write(0x004C, 0x7647)
    status = registers.read(0x0050)
    assert status >> 11 == 1
    assert (status & 0x3FF) * 0.19 - 56.0 == pytest.approx(39.0, abs=0.1)


def test_the_light_meter_answers_while_it_is_on():
    registers = Registers(Surroundings(lux=250.0))
    assert registers.read(0x0010) == 0
    registers.write(0x000C, 7)
    status = registers.read(0x0010)
    assert status >> 29 == 1
    assert 10**3.5 / (0.37 * (status & ((1 << 27) - 1)) / 100) == pytest.approx(250.0, rel=1e-3)


def test_the_dead_time_is_measured_when_asked_for():
    registers = Registers(Surroundings(dead_time_us=80.0))
    registers.write(0x0020, 0xC000_0000)
    value = registers.read(0x0020)
    assert value >> 28 & 1
    assert (value & 0x0FFF_FFFF) / 200 == 80.0


def test_the_dead_time_that_is_measured_follows_its_bias():
    registers = Registers(Surroundings(dead_time_us=80.0), BiasModel(BiasSlopes(refr=0.1)))
    registers.write(0x1020, 0x11A1_0014 + 10)
    registers.write(0x0020, 0xC000_0000)
    assert (registers.read(0x0020) & 0x0FFF_FFFF) / 200 == 40.0


def test_a_reset_brings_back_what_was_at_power_on():
    registers = Registers()
    before = {address: registers.read(address) for address in (0x1010, 0x9008, 0x0014, 0x600C)}
    for address in before:
        registers.write(address, 0x1234)
    registers.write(0x40_0004, 1)
    assert {address: registers.read(address) for address in before} == before


def test_the_chip_and_the_status_cannot_be_written():
    registers = Registers()
    registers.write(0x0014, 0)
    registers.write(0x0050, 0x800)
    assert registers.read(0x0014) == 0xA040_1806
    assert registers.read(0x0050) == 0


def test_another_output_format_is_not_taken():
    registers = Registers()
    registers.write(0x7000, 0x0007_0003)
    assert registers.read(0x7000) == 0x0007_0001


@pytest.mark.parametrize("address", [1, 2, 0x1_0000, 0x3F_FFFC, 0x40_1000, 0xFFFF_FFFC, -4])
def test_where_no_register_lies_there_is_an_error(address):
    registers = Registers()
    with pytest.raises(NoRegister, match="no register"):
        registers.read(address)
    with pytest.raises(NoRegister, match="no register"):
        registers.write(address, 1)


@given(
    st.integers(0, 0x3FFF).filter(lambda k: 4 * k not in {0x10, 0x14, 0x20, 0x34, 0x50, 0x7000}),
    st.integers(0, 2**32 - 1),
)
def test_all_others_remember(place, value):
    registers = Registers()
    registers.write(4 * place, value)
    assert registers.read(4 * place) == value
