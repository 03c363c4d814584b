"""The registers of a board with a Gen 3.1 that hosts use: 32 bits each, at byte addresses in steps of 4, 0 to 1FFC.

    0000            power: bit 0 analogue supply; bit 18 (TD_RSTN) time runs
    0008            bits 8 (HOST_IF_EN) and 9 (STEREO_MERGE_ENABLE) events go to the host
    000C            bit 0 (written 1) reset of all registers
    01A0            bit 0 trigger input on
    0204            array: bit 1 windows act; 3 pixels run; 5 (written 1) windows take over
    0214            light meter: bits 30, 31 on; bit 29 valid, 25..0 count of 10 ns
    0218            chip: 90200C02
    0238            bit 0 clock of the output runs
    0248            noise filter: bit 0 on
    024C            its least events in a period in bits 13..0, its period, us, in 23..14
    034C - 0364     biases: bit 27 a voltage, in bits 7..0; else a current, in bits 20..8
    0400 + 4 i      20 words of columns, 0500 + 4 i  15 of rows: bit k of word i is pixel 32 i + k, 1 in the window
    0800            28, number of the system

Other registers only store their value. A pixel is in the window if its column and its row are. Rows count from the top.

The registers from 0200 to 073F are the sensor's, the others the board's. Power-on values of the array, the noise filter
and the windows are those of OpenEB's register maps, the biases those that drivers write when they open the sensor, and
the numbers of chip and system those that drivers check; all others are 0. Inferred: what the bits of the gate do, from
the order in which drivers write them; that a reset of the board (SOFT_RESET) is one of the sensor as well; that windows
take over with each write of bit 5; that the light meter has its count at once.

Sources: OpenEB 5.1.1, register maps, drivers and sequence of the Gen 3.1 of an EVK3 (gen31_ccam5_tz_device.cpp,
gen31_evk3_issd.h, gen31_ll_biases.cpp, gen31_roi_command.cpp and others); neuromorphic_drivers, centuryarks_vga.rs.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import IntEnum

from firmware_protocol.prophesee.registers import ChipRegisters, Form

SIZE = (640, 480)
CHIP = 0x9020_0C02

_END = 0x2000
_SYSTEM = 0x28
_TIME = 1 << 18
_SUPPLY_AND_TIME = _TIME | 1
_TO_HOST = 3 << 8
_PIXELS_RUN = 1 << 3
_METER_ON = 3 << 30
_METER_VALID = 1 << 29
_METER_COUNT = (1 << 26) - 1
_COUNT_AT_1_LUX = 100 * 10**3.5 / 0.37  # OpenEB: lux = 10^(3.5 - log10(0.37 t)), t in us
_IS_VOLTAGE = 1 << 27


class Address(IntEnum):
    """Registers that have an effect, or that the camera reads."""

    POWER = 0x0000
    HOST = 0x0008
    RESET = 0x000C
    TRIGGERS = 0x01A0
    ARRAY = 0x0204
    LIGHT = 0x0214
    CHIP = 0x0218
    CLOCK = 0x0238
    NOISE = 0x0248
    NOISE_RATE = 0x024C
    COLUMNS = 0x0400
    ROWS = 0x0500
    SYSTEM = 0x0800


BIASES: Mapping[str, tuple[int, int]] = {
    "diff_off": (0x034C, 0x1E),
    "diff_on": (0x0350, 0x35),
    "diff": (0x0354, 0x29),
    "fo": (0x0358, 0x3D),
    "pr": (0x035C, 0x34F),
    "refr": (0x0360, 0x4F),
    "hpf": (0x0364, 0x6),
}
"""Register and value at open of each bias, by Prophesee's names."""

_POWER_ON: Mapping[int, int] = {
    Address.ARRAY: 0xB,
    Address.CHIP: CHIP,
    Address.NOISE: 0xC8,
    Address.NOISE_RATE: 100 << 14 | 50,
    0x034C: 0x7900_571E,
    0x0350: 0x7912_5C35,
    0x0354: 0x7902_CE29,
    0x0358: 0x7100_3DD6,
    0x035C: 0x5103_4FB1,
    0x0360: 0x5100_4FD4,
    0x0364: 0x5100_06D4,
    **{Address.COLUMNS + 4 * i: 0xFFFF_FFFF for i in range(20)},
    **{Address.ROWS + 4 * i: 0xFFFF_FFFF for i in range(15)},
    Address.SYSTEM: _SYSTEM,
}


class Registers(ChipRegisters):
    """The register file, from power-on; `lux`: light on the chip, which the light meter reports."""

    form: Form = "evt3"

    def __init__(self, lux: float = 100.0) -> None:
        count = _COUNT_AT_1_LUX / lux if lux > 0 else _METER_COUNT
        self._light = _METER_VALID | min(max(round(count), 1), _METER_COUNT)
        super().__init__(_END // 4, BIASES, _POWER_ON)

    def write(self, address: int, value: int) -> None:
        """Write a register, and apply its effect within the sensor; raises NoRegister."""
        if address in (Address.CHIP, Address.SYSTEM):
            return
        if address == Address.RESET and value & 1:
            self.power_on()
        self._set(address, value)
        if address == Address.LIGHT:
            self._set(address, value & _METER_ON | (self._light if value & _METER_ON == _METER_ON else 0))

    @property
    def currents(self) -> dict[str, int]:
        """Value of each bias, by Prophesee's names: code of its voltage or of its current, whichever is selected."""
        words = {name: self[address] for name, (address, _) in BIASES.items()}
        return {name: word & 0xFF if word & _IS_VOLTAGE else word >> 8 & 0x1FFF for name, word in words.items()}

    @property
    def bias_steps(self) -> dict[str, int]:
        """Steps of each bias away from its value at open; of diff_on and diff_off, of their distance from diff."""
        steps = super().bias_steps
        reference = steps.pop("diff")
        return {**steps, "diff_on": steps["diff_on"] - reference, "diff_off": reference - steps["diff_off"]}

    @property
    def time_runs(self) -> bool:
        """True if the sensor's clock runs."""
        return bool(self[Address.POWER] & _TIME)

    @property
    def running(self) -> bool:
        """True if events leave the sensor."""
        powered = self[Address.POWER] & _SUPPLY_AND_TIME == _SUPPLY_AND_TIME
        leaves = self[Address.HOST] & _TO_HOST == _TO_HOST and self[Address.CLOCK] & 1
        return powered and bool(leaves and self[Address.ARRAY] & _PIXELS_RUN)

    @property
    def has_trigger(self) -> bool:
        """True if the trigger input is on."""
        return bool(self[Address.TRIGGERS] & 1)
