"""The registers of the GenX320 that hosts use; 32 bits each, at byte addresses in steps of 4, from 0 to FFFC.

    0000            array control: bit 1 masks on, 5 (rising) latches take over, 10 pixels run
    0008, 0010      light meter: control (bit 0 on); status: bits 27..0 count, 28 valid, cleared by writing 1
    0014            chip: B0602003
    001C            bit 0 (written 1) reset of all registers
    0020            dead time: bits 31 and 30 start; bit 28 valid, 27..0 count (50 per us)
    0034            windows: bit 0 on, 1 run, 2 outside, 7..3 their number; 17 done
    004C, 0050      thermometer: bit 2 start; status: bits 9..0 value (0.216 degrees C each, from -54), 11 done
    00B8            bit 0 memory of the anti-flicker filter on
    0400 + 8 i      18 windows: first column 8..0, end 24..16;  0404 + 8 i  rows likewise
    0608            bits 10 and 14 pad of the trigger input on
    1000 - 1144     biases: value in bits 6..0
    2000 + 4 i      10 words of latch data (1 masks); 3000 + 4 i  10 words of rows: bit k of word i is pixel 32 i + k
    6000            rate control: bit 0 on, 2 bypass; 6014 bit 2 it drops, 31 ready
    6020, 602C      its period, us, bits 9..0; events that pass in a period, bits 20..0
    7040            bit 10 triggers in the stream
    7044            bits 1..0 output format: 0 EVT2, 1 EVT3, 2 EVT2.1
    9008            bit 0 time runs
    900C            crop: bit 0 on, 2 drop what is outside, 4 new origin; 9010 first column 8..0, row 24..16; 9014 last
    9028            bit 1 no output
    9100 + 8 i      16 masks of 32 pixels: column / 32 in bits 3..0, row 12..4, 31 on; 9104 + 8 i  the pixels
    C000 - C0C4     anti-flicker filter, see `selection`; C0C4 bit 2 ready while 00B8 bit 0 is 1
    D000 - D0C4     filter of trails: C0C4's bits in D0C4, bit 0 starts
    E000 - E018     noise filter, see `selection`
    F008            mailbox of the processor: it takes a command at once, and sets the upper octet to 0
    F010            CAFEBABE, the processor has booted

Other registers only store their value. Rows count from the top.

Power-on values are those that OpenEB's register map lists for the engineering sample, but the biases, which are those
that OpenEB writes to the sensor in production when it opens it, and the format: 2, because OpenEB offers EVT2.1 first
and its users' cameras send it (metavision_driver, pull request 62). Inferred: that the latches take over only the rows
that 3000 selects; that windows write the same latches; that the light meter has its count at once.

Sources: OpenEB 5.1.1, register map, drivers and sequences of the GenX320 (genx320_cx3_tz_device.cpp,
genx320mp_cx3_issd.h, genx320_roi_driver.cpp, genx320_erc.cpp and others); OpenMV's driver (F010).
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.prophesee.biases import BiasModel
from firmware_protocol.prophesee.registers import ChipRegisters, Form, SensorSurroundings
from firmware_protocol.prophesee.treuzell import RegisterBus
from firmware_protocol.prophesee.v4l2 import (
    EVT3_FORMAT,
    NodeSensor,
    PixelFormat,
    RateRegisters,
    Window,
    bias_controls,
)

SIZE = (320, 320)
WINDOWS, MASKS = 18, 16
CHIP = 0xB060_2003

_END = 0x1_0000
_VALID = 1 << 28
_MEASURE_DEAD_TIME = 3 << 30
_ADC_DONE = 1 << 11
_READY = 1 << 2
_WINDOWS_DONE = 1 << 17
_RATE_READY = 1 << 31
_PADS, _TRIGGERS = 1 << 10 | 1 << 14, 1 << 10
_FORMS: tuple[Form, ...] = ("evt2", "evt3", "evt21", "evt21")


class Address(IntEnum):
    """Registers that have an effect, or that the camera reads."""

    ARRAY = 0x0000
    LIGHT_CONTROL = 0x0008
    LIGHT_STATUS = 0x0010
    CHIP = 0x0014
    RESET = 0x001C
    DEAD_TIME = 0x0020
    WINDOW_CONTROL = 0x0034
    ADC_CONTROL = 0x004C
    ADC_STATUS = 0x0050
    MEMORIES = 0x00B8
    WINDOWS = 0x0400
    PADS = 0x0608
    COLUMNS = 0x2000
    ROWS = 0x3000
    RATE = 0x6000
    RATE_DROPS = 0x6014
    RATE_PERIOD = 0x6020
    RATE_EVENTS = 0x602C
    EVENT_TYPES = 0x7040
    FORMAT = 0x7044
    TIME = 0x9008
    CROP = 0x900C
    CROP_START = 0x9010
    CROP_END = 0x9014
    OUTPUT = 0x9028
    MASKS = 0x9100
    FLICKER = 0xC000
    FLICKER_PARAMETERS = 0xC008
    FLICKER_PERIODS = 0xC00C
    FLICKER_READY = 0xC0C4
    TRAIL = 0xD000
    TRAIL_READY = 0xD0C4
    NOISE = 0xE000
    NOISE_PERIOD = 0xE008
    NOISE_LOW_ON = 0xE00C
    NOISE_LOW_OFF = 0xE010
    NOISE_HIGH_OFF = 0xE014
    NOISE_HIGH_ON = 0xE018
    MAILBOX = 0xF008
    BOOTED = 0xF010


BIASES: Mapping[str, tuple[int, int]] = {
    "pr": (0x1000, 0x3D),
    "fo": (0x1004, 34),
    "fes": (0x1008, 0x3F),
    "hpf": (0x1100, 40),
    "diff_on": (0x1104, 25),
    "diff": (0x1108, 51),
    "diff_off": (0x110C, 28),
    "inv": (0x1110, 0x39),
    "refr": (0x1114, 10),
    "invp": (0x1118, 0x38),
}
"""Register and value at open of each bias, by Prophesee's names."""

_POWER_ON = {
    Address.ARRAY: 0x400,
    Address.CHIP: CHIP,
    0x002C: 0x0020_0624,
    0x0044: 0x14,
    Address.ADC_CONTROL: 0x0020_4E20,
    Address.ADC_STATUS: 0x2082_0000,
    0x0054: 0x4008_0000,
    0x005C: 0x80,
    0x0070: 0x55C,
    0x00BC: 0x3FFF_FFFF,
    0x00C0: 0xF8,
    0x0600: 0x2739_CE73,
    0x0604: 0x2751_4EB3,
    Address.PADS: 0x0421_4EA2,
    0x060C: 0x0421_0842,
    0x1000: 0x0301_0000,
    0x1004: 0x0301_0000,
    0x1008: 0x0101_0000,
    0x1100: 0x0301_0000,
    0x1104: 0x0101_0000,
    0x1108: 0x0101_0000,
    0x110C: 0x0101_0000,
    0x1110: 0x0101_0000,
    0x1114: 0x0309_0000,
    0x1118: 0x0301_0000,
    0x111C: 0x0300_0074,
    0x1120: 0x0100_00A4,
    **{Address.COLUMNS + 4 * i: 0xFFFF_FFFF for i in range(10)},
    **{Address.ROWS + 4 * i: 0xFFFF_FFFF for i in range(10)},
    0x6004: 1,
    Address.RATE_DROPS: _RATE_READY | 0x2010,
    Address.RATE_PERIOD: 0x80,
    Address.RATE_EVENTS: 0x80,
    0x60A0: 1,
    Address.EVENT_TYPES: 0xC5FF,
    Address.FORMAT: 2,
    0x704C: 0x7D0,
    Address.TIME: 0x320,
    Address.FLICKER_PARAMETERS: 0x34,
    Address.FLICKER_PERIODS: 0x0008_9C0F,
    0xC0C0: 0x0505_AF3C,
    0xD008: 0x0100_4E20,
    0xD00C: 0x0003_0D40,
    0xD010: 0x0001_022D,
    0xD0C0: 0x0511_8004,
    Address.NOISE_PERIOD: 0x400,
    Address.NOISE_LOW_ON: 0x20,
    Address.NOISE_LOW_OFF: 0x20,
    Address.NOISE_HIGH_OFF: 0x1F_FFFF,
    Address.NOISE_HIGH_ON: 0x1F_FFFF,
    0xB000: 0x1000_C000,
    Address.BOOTED: 0xCAFE_BABE,
}
_POWER_ON |= {address: _POWER_ON[address] | value for address, value in BIASES.values()}


@dataclass(frozen=True)
class Surroundings(SensorSurroundings):
    """Readings of the sensor's own instruments; the thermometer reads -54 to 166 degrees."""

    lowest_celsius = -54.0
    celsius_per_count = 0.216
    counts_per_us = 50.0

    @property
    def light_count(self) -> int:
        """Count of the light meter, 1 to 2^28 - 1: lux = exp(11.97 - 0.98 ln(count))."""
        if self.lux <= 0:
            return _VALID - 1
        return min(max(round(math.exp((11.97 - math.log(self.lux)) / 0.98)), 1), _VALID - 1)


class Registers(ChipRegisters):
    """The register file, from power-on."""

    array_control = Address.ARRAY
    bias_bits = 0x7F

    def __init__(self, surroundings: Surroundings = Surroundings(), biases: BiasModel | None = None) -> None:
        self._around = surroundings
        self._biases = biases or BiasModel()
        super().__init__(_END // 4, BIASES, _POWER_ON)

    def write(self, address: int, value: int) -> None:
        """Write a register, and apply its effect within the sensor; raises NoRegister."""
        if address in (Address.CHIP, Address.ADC_STATUS, Address.BOOTED):
            return
        if address == Address.RESET and value & 1:
            self.power_on()
            self._set(address, value)
            return
        before = self[address]
        self._set(address, value)
        self._measure(address, value, before)
        self._report_readiness(address, value)

    def _measure(self, address: int, value: int, before: int) -> None:
        """Start one of the sensor's own instruments, whose reading is there at once."""
        if address == Address.ADC_CONTROL and value & 4:
            self._set(Address.ADC_STATUS, _ADC_DONE | self._around.adc)
        elif address == Address.DEAD_TIME and value & _MEASURE_DEAD_TIME == _MEASURE_DEAD_TIME:
            factor = self._biases.factors(self.bias_steps).get("refractory_us", 1.0)
            self._set(address, _MEASURE_DEAD_TIME | _VALID | self._around.dead_time_count(factor))
        elif address == Address.LIGHT_CONTROL and value & ~before & 1:
            self._set(Address.LIGHT_STATUS, _VALID | self._around.light_count)
        elif address == Address.LIGHT_STATUS:
            self._set(address, 0 if value & _VALID else before)

    def _report_readiness(self, address: int, value: int) -> None:
        """Set the bits by which parts of the sensor report that they are ready."""
        if address == Address.MEMORIES:
            self._set(Address.FLICKER_READY, _READY if value & 1 else 0)
        elif address == Address.FLICKER_READY:
            self._set(address, value & ~_READY | (_READY if self[Address.MEMORIES] & 1 else 0))
        elif address == Address.TRAIL_READY:
            self._set(address, _READY if value & 1 else 0)
        elif address == Address.WINDOW_CONTROL:
            self._set(address, value & 0xFF | (_WINDOWS_DONE if value & 3 == 3 else 0))
        elif address == Address.RATE_DROPS:
            self._set(address, value | _RATE_READY)
        elif address == Address.MAILBOX:
            self._set(address, value & 0x00FF_FFFF)

    @property
    def form(self) -> Form:
        """Form of the words that leave the sensor; the fourth value, 3, is not defined: EVT2.1 here."""
        return _FORMS[self[Address.FORMAT] & 3]

    @property
    def has_trigger(self) -> bool:
        """True if the trigger input is on."""
        return self[Address.PADS] & _PADS == _PADS and bool(self[Address.EVENT_TYPES] & _TRIGGERS)


_V4L2_LIMITS = {
    "fo": (19, 39),
    "hpf": (0, 127),
    "diff_on": (24, 60),
    "diff": (41, 51),
    "diff_off": (19, 50),
    "refr": (0, 127),
}
_LATCHES_ON = 1 << 1


def _select_windows(bus: RegisterBus, windows: Sequence[Window], outside: bool) -> None:
    """Write all windows, and have the sensor set the latches of its pixels by them."""
    for k, window in enumerate(windows):
        bus.write_register(Address.WINDOWS + 8 * k, (window.x + window.width) << 16 | window.x)
        bus.write_register(Address.WINDOWS + 8 * k + 4, (window.y + window.height) << 16 | window.y)
    bus.write_register(Address.ARRAY, bus.read_register(Address.ARRAY) | _LATCHES_ON)
    bus.write_register(Address.WINDOW_CONTROL, len(windows) << 3 | outside << 2 | 3)


V4L2_SENSOR = NodeSensor(
    "genx320",
    SIZE,
    (EVT3_FORMAT, PixelFormat(b"PSE2", 0x5303, "evt21"), PixelFormat(b"PSEE", 0x5300, "evt2")),
    bias_controls(BIASES, _V4L2_LIMITS),
    0x7F,
    RateRegisters(
        Address.RATE_PERIOD,
        Address.RATE_EVENTS,
        period_us=100,
        initial_events=1000,
        on=((Address.RATE_DROPS, 4), (Address.RATE, 1)),
        off=((Address.RATE_DROPS, 0),),
    ),
    _select_windows,
    has_windows=True,
)
"""The sensor on V4L2."""
