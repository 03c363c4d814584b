"""The sensor's registers: power-on, instruments, gate, and addresses that are none."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.imx636.registers import GEN41, IMX636, IMX646, Registers, Surroundings
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes
from firmware_protocol.prophesee.registers import NoRegister


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
    for address, value in ((0x0014, 0), (0xF128, 2), (0x0050, 0x800)):
        registers.write(address, value)
    assert registers.read(0xF128) == 0
    assert registers.read(0x0014) == 0xA040_1806
    assert registers.read(0x0050) == 0


def test_the_output_format_is_one_bit_until_a_reset():
    registers = Registers()
    for value, form in ((0x0007_0003, "evt21-legacy"), (0x0007_0001, "evt3"), (0x0007_0003, "evt21-legacy")):
        registers.write(0x7000, value)
        assert (registers.read(0x7000), registers.form) == (value, form)
    registers.write(0x40_0004, 1)
    assert registers.form == "evt3"


def test_the_anti_flicker_filter_is_ready_as_openeb_requires():
    """When it switches the filter on, it writes C000 and reads bit 2 of C0C4 up to three times."""
    registers = Registers()
    registers.write(0xC000, 0b101)
    assert registers.read(0xC0C4) == 0b100
    registers.write(0xC0C4, 0b001)
    assert registers.read(0xC0C4) == 0b101


# The values that OpenEB 5.1.1 compares: imx636_tz_device.cpp, imx646_tz_device.cpp, gen41_tz_device.cpp.
@pytest.mark.parametrize(
    ("chip", "number", "variant"), [(IMX636, 0xA040_1806, 0), (IMX646, 0xA040_1806, 2), (GEN41, 0xA030_1003, 0)]
)
def test_each_chip_has_its_number_and_its_biases(chip, number, variant):
    registers = Registers(chip=chip)
    assert (registers.read(0x0014), registers.read(0xF128) & 3) == (number, variant)
    assert set(registers.bias_steps.values()) == {0}
    registers.write(0x1010, 0)
    assert registers.bias_steps["diff_on"] == (-0x73 if chip is GEN41 else -0x66)
    registers.write(0x40_0004, 1)
    assert set(registers.bias_steps.values()) == {0}


@pytest.mark.parametrize("address", [1, 2, 0x1_0000, 0x3F_FFFC, 0x40_1000, 0xFFFF_FFFC, -4])
def test_where_no_register_lies_there_is_an_error(address):
    registers = Registers()
    with pytest.raises(NoRegister, match="no register"):
        registers.read(address)
    with pytest.raises(NoRegister, match="no register"):
        registers.write(address, 1)


@given(
    st.integers(0, 0x3FFF).filter(lambda k: 4 * k not in {0x10, 0x14, 0x20, 0x34, 0x50, 0xC0C4, 0xF128}),
    st.integers(0, 2**32 - 1),
)
def test_all_others_remember(place, value):
    registers = Registers()
    registers.write(4 * place, value)
    assert registers.read(4 * place) == value
