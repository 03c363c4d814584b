"""The registers of the IMX636 that hosts use; 32 bits each, at byte addresses in steps of 4.

    0004            array control: bit 1 masks on, 5 masks take effect, 6 pass inside (0: mask where both masks
                    cross), 10 pixels run
    000C, 0010      light meter: control (bit 0 on); status: bits 26..0 count (100 per us), 29 valid
    0014            chip: A0401806 of an IMX636 and an IMX646, A0301003 of a Gen4.1
    0020            dead time: bit 31 and 30 start; bit 28 valid, 27..0 count (200 per us)
    0034, 0038, 003C  window: bit 0 write the masks from it, 1 done; first column 10..0, row 25..16; end likewise
    004C, 0050      thermometer: bit 2 start; status: bits 9..0 value (0.19 degrees C each, from -56), 11 done
    1000 - 1050     biases: current in bits 7..0
    2000 + 4 i      40 words of column masks, 4000 + 4 i  23 words of row masks: bit k of word i is pixel 32 i + k
    6000            rate control: bits 1..0 = 1 ready; 6008 period, us, 600C events a period, 6028 bit 0 on,
                    6050 bit 0 drops
    7000            bit 1 output format, 0: EVT3, 1: EVT2.1;  7004 bit 10 trigger input on
    8000            bits 7..6 order of octets, which each driver sets for its format: 2 for EVT3, 0 for EVT2.1
    9008            bit 0 time runs
    9028            bit 1 no output
    9100 + 4 i      64 words of masked pixels: column 10..0, row 25..16, bit 31 on
    C0C4            anti-flicker filter: bit 2 its memory is ready, always 1
    F128            bits 1..0 variant of the chip: 0 IMX636, 2 IMX646
    00400000        bit 0 of 400004: reset

Other registers only store their value, 8000 among them: words leave in the order that drivers set for their format.
Addresses from 0 to FFFC and from 400000 to 400FFC exist. There is no EVT2: the format has one bit. Rows count from the
top, as in EVT3 and OpenEB; neuromorphic_drivers counts those of masks from the bottom.

The effect of the biases on the pixels is in `prophesee.biases`.

A Gen4.1, the sensor before the IMX636, has the same registers as far as hosts use them, and other biases.

Sources: register maps and drivers of OpenEB 5.1.1; registers that neuromorphic_drivers writes and reads; Prophesee's
Linux driver of the IMX636 (the orders of octets). Factory values of the biases are those in neuromorphic_drivers, of a
Gen4.1 those that OpenEB and neuromorphic_drivers write when they open it; no source gives those of an IMX646, which
here are an IMX636's. That the anti-flicker filter's memory is ready from power-on is inferred: OpenEB reads the bit
three times when it switches the filter on, and nothing requests it. The power-on values of other registers are not
public: 0 here.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np

from firmware_protocol.prophesee.biases import BiasModel
from firmware_protocol.prophesee.registers import ChipRegisters, Form, NoRegister, SensorSurroundings
from firmware_protocol.prophesee.treuzell import RegisterBus
from firmware_protocol.prophesee.v4l2 import (
    EVT3_FORMAT,
    NodeSensor,
    PixelFormat,
    RateRegisters,
    Window,
    bias_controls,
)

SIZE = (1280, 720)
PIXEL_MASKS = 64

_LOW_END = 0x1_0000
_SYSTEM = 0x40_0000
_SYSTEM_END = 0x40_1000
_FILTER_IS_READY = 1 << 2
_READY = 1 << 11
_VALID_LIGHT = 1 << 29
_VALID_DEAD_TIME = 1 << 28
_MEASURE_DEAD_TIME = 3 << 30


class Address(IntEnum):
    """Registers that have an effect, or that the camera reads."""

    ARRAY = 0x0004
    LIGHT_CONTROL = 0x000C
    LIGHT_STATUS = 0x0010
    CHIP = 0x0014
    DEAD_TIME = 0x0020
    WINDOW = 0x0034
    WINDOW_START = 0x0038
    WINDOW_END = 0x003C
    ADC_CONTROL = 0x004C
    ADC_STATUS = 0x0050
    COLUMNS = 0x2000
    ROWS = 0x4000
    RATE_STATE = 0x6000
    RATE_PERIOD = 0x6008
    RATE_EVENTS = 0x600C
    RATE_ON = 0x6028
    RATE_DROPS = 0x6050
    FORMAT = 0x7000
    TRIGGER = 0x7004
    OCTETS = 0x8000
    TIME = 0x9008
    OUTPUT = 0x9028
    PIXELS = 0x9100
    FILTER_READY = 0xC0C4
    VARIANT = 0xF128
    RESET = 0x40_0004


BIASES: Mapping[str, tuple[int, int]] = {
    "pr": (0x1000, 0x7C),
    "fo": (0x1004, 0x53),
    "hpf": (0x100C, 0x00),
    "diff_on": (0x1010, 0x66),
    "diff": (0x1014, 0x4D),
    "diff_off": (0x1018, 0x49),
    "inv": (0x101C, 0x5B),
    "refr": (0x1020, 0x14),
    "reqpuy": (0x1040, 0x8C),
    "reqpux": (0x1044, 0x7C),
    "sendreqpdy": (0x1048, 0x94),
    "unknown_1": (0x104C, 0x74),
    "unknown_2": (0x1050, 0x51),
}
"""Register and factory's current of each bias, by Prophesee's names."""


@dataclass(frozen=True)
class Chip:
    """A version of the sensor.

    Attributes
    ----------
    name : its name in the board's own description, for people.
    compatible : names by which OpenEB finds its driver.
    number, variant : values of the registers CHIP and VARIANT.
    biases : register and factory's current of each bias, by Prophesee's names.
    bias_flags : the other bits of the bias registers at power-on.
    """

    name: str
    compatible: tuple[str, ...]
    number: int = 0xA040_1806
    variant: int = 0
    biases: Mapping[str, tuple[int, int]] = field(default_factory=lambda: BIASES)
    bias_flags: int = 0x11A1_0000


IMX636 = Chip("CCam5 Imx636 Event-Based Camera", ("psee,ccam5_imx636", "psee,ccam5_gen42"))
IMX646 = Chip("CCam5 Imx646 Event-Based Camera", ("psee,ccam5_imx646",), variant=2)
GEN41 = Chip(
    "CCam5 Gen4.1 Event-Based Camera",
    ("psee,ccam5_gen41",),
    number=0xA030_1003,
    biases={
        "pr": (0x1000, 0x69),
        "fo": (0x1004, 0x4A),
        "fo_n": (0x1008, 0x00),
        "hpf": (0x100C, 0x00),
        "diff_on": (0x1010, 0x73),
        "diff": (0x1014, 0x50),
        "diff_off": (0x1018, 0x34),
        "inv": (0x101C, 0x5B),
        "refr": (0x1020, 0x44),
        "reqpuy": (0x1040, 0x94),
        "reqpux": (0x1044, 0x7C),
        "sendreqpdy": (0x1048, 0x94),
        "blk": (0x104C, 0x78),
        "unknown_2": (0x1050, 0x51),
    },
)
"""The sensors of the boards that are emulated; names of the two that are no IMX636 follow the pattern of its name."""


@dataclass(frozen=True)
class Surroundings(SensorSurroundings):
    """Readings of the sensor's own instruments; the thermometer reads -56 to 138 degrees."""

    lowest_celsius = -56.0
    celsius_per_count = 0.19
    counts_per_us = 200.0

    @property
    def light_count(self) -> int:
        """Hundredths of a microsecond that the light meter counts: lux = 10^3.5 / (0.37 us)."""
        return min(round(100.0 * 10**3.5 / (0.37 * self.lux)), (1 << 27) - 1)


class Registers(ChipRegisters):
    """The register file, from power-on."""

    array_control = Address.ARRAY
    bias_bits = 0xFF

    def __init__(
        self, surroundings: Surroundings = Surroundings(), biases: BiasModel | None = None, chip: Chip = IMX636
    ) -> None:
        self._around = surroundings
        self._biases = biases or BiasModel()
        values = {address: chip.bias_flags | current for address, current in chip.biases.values()}
        values |= {Address.CHIP: chip.number, Address.VARIANT: chip.variant, Address.RATE_PERIOD: 0x80}
        values |= {Address.RATE_EVENTS: 0x80, Address.WINDOW_END: SIZE[1] << 16 | SIZE[0]}
        super().__init__((_LOW_END + _SYSTEM_END - _SYSTEM) // 4, chip.biases, values)

    def read(self, address: int) -> int:
        """Return a register's value; raises NoRegister."""
        if address == Address.LIGHT_STATUS and self[Address.LIGHT_CONTROL] & 1:
            return _VALID_LIGHT | self._around.light_count
        return self[address] | _FILTER_IS_READY if address == Address.FILTER_READY else self[address]

    def write(self, address: int, value: int) -> None:
        """Write a register, and apply its effect within the sensor; raises NoRegister."""
        if address in (Address.CHIP, Address.VARIANT, Address.ADC_STATUS):
            return
        self._set(address, value)
        if address == Address.RESET and value & 1:
            self.power_on()
            self._set(address, value)
        elif address == Address.ADC_CONTROL and value & 4:
            self._set(Address.ADC_STATUS, _READY | self._around.adc)
        elif address == Address.DEAD_TIME and value & _MEASURE_DEAD_TIME == _MEASURE_DEAD_TIME:
            factor = self._biases.factors(self.bias_steps).get("refractory_us", 1.0)
            self._set(address, _MEASURE_DEAD_TIME | _VALID_DEAD_TIME | self._around.dead_time_count(factor))
        elif address == Address.WINDOW and value & 1:
            self._write_window()
            self._set(address, value | 2)

    @property
    def form(self) -> Form:
        """Form of the words that leave the sensor."""
        return "evt21-legacy" if self[Address.FORMAT] & 2 else "evt3"

    @property
    def has_trigger(self) -> bool:
        """True if the trigger input is on."""
        return bool(self[Address.TRIGGER] & 1 << 10)

    def _write_window(self) -> None:
        """Set the masks to hide the pixels outside the window."""
        start, end = self[Address.WINDOW_START], self[Address.WINDOW_END]
        for address, pixels, shift in ((Address.COLUMNS, SIZE[0], 0), (Address.ROWS, SIZE[1], 16)):
            masked = np.ones(-(-pixels // 32) * 32, np.uint8)
            masked[start >> shift & 0x7FF : end >> shift & 0x7FF] = 0
            words = np.packbits(masked, bitorder="little").view("<u4")
            self.words(address, len(words))[:] = words

    def _place(self, address: int) -> int:
        if address & 3 or not (0 <= address < _LOW_END or _SYSTEM <= address < _SYSTEM_END):
            raise NoRegister(f"no register at 0x{address:08X}")
        return address // 4 if address < _LOW_END else (address - _SYSTEM + _LOW_END) // 4


_V4L2_LIMITS = dict.fromkeys(("fo", "hpf", "diff_on", "diff", "diff_off", "refr"), (0, 255))
_MASKS_TAKE_EFFECT = 1 << 1 | 1 << 5 | 1 << 6


def _select_windows(bus: RegisterBus, windows: Sequence[Window], outside: bool) -> None:
    """Write one window and have the masks of it take effect, with those of the columns and of the rows together."""
    window = windows[0]
    bus.write_register(Address.WINDOW_START, window.y << 16 | window.x)
    bus.write_register(Address.WINDOW_END, (window.y + window.height) << 16 | (window.x + window.width))
    bus.write_register(Address.WINDOW, 1)
    bus.write_register(Address.ARRAY, bus.read_register(Address.ARRAY) | _MASKS_TAKE_EFFECT)


V4L2_SENSOR = NodeSensor(
    "imx636",
    SIZE,
    (EVT3_FORMAT, PixelFormat(b"PSE1", 0x5301, "evt21-legacy")),
    bias_controls(BIASES, _V4L2_LIMITS),
    0xFF,
    RateRegisters(
        Address.RATE_PERIOD,
        Address.RATE_EVENTS,
        period_us=200,
        initial_events=4000,
        on=((Address.RATE_ON, 1), (Address.RATE_DROPS, 1), (Address.RATE_STATE, 1)),
        off=((Address.RATE_DROPS, 0),),
    ),
    _select_windows,
    has_windows=False,
)
"""The sensor on V4L2."""
