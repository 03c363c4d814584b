"""Registers of iniVation's cameras with an FX3: 32-bit parameters in modules, as declared data, and their values.

    module  0 multiplexer   1 DVS   2 APS   3 IMU   4 external input   5 bias (0-127) and chip (128-255)
            6 system information   9 USB

Modules 0, 4, 6 and 9 are the same in all models, but for some power-on values; `shared_registers` declares them.

Source: libcaer 3.3.15 (davis.h, dvxplorer.h), neuromorphic-drivers 0.16.1, register traffic of three drivers.

Behaviour that these sources do not describe: the FPGA cannot refuse a request. A write to a register that does not
exist, or that is read-only, is ignored; a read of one that does not exist gives 0. A register stores as many low bits
of a written value as its part of the logic uses, one for a flag, and reads back those.

Run gate: the run bits that control the data path.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from enum import Enum, IntEnum


class Module(IntEnum):
    """wValue of a register request."""

    MULTIPLEXER = 0
    DVS = 1
    APS = 2
    IMU = 3
    EXTERNAL_INPUT = 4
    BIAS = 5
    SYSTEM = 6
    USB = 9


class Access(Enum):
    """Access that a host has."""

    READ_ONLY = "read"
    READ_WRITE = "read and write"


@dataclass(frozen=True)
class Register:
    """One parameter of one module, with its power-on value."""

    module: Module
    address: int
    name: str
    default: int = 0
    access: Access = Access.READ_WRITE
    note: str = ""
    bits: int = 1


@dataclass(frozen=True)
class SystemInfo:
    """Module 6: data of the logic. The clocks are exact here (deviation 1000 thousandths). `adc_clock_mhz` 0: none."""

    logic_version: int = 18
    chip_id: int = 5
    timestamp_master: bool = True
    logic_clock_mhz: int = 104
    adc_clock_mhz: int = 30
    usb_clock_mhz: int = 80
    clock_deviation: int = 1000
    logic_patch: int = 1


Rows = tuple[tuple[int, str, int] | tuple[int, str, int, int], ...]
"""Address, name, power-on value, and the width in bits unless it is a flag."""


def _external_input(clock_mhz: int) -> Rows:
    """Power-on values of the published logic (ExtInputConfigRecords.vhd): pulses of 1 us, the generator at 1 MHz."""
    bits = 20 + clock_mhz.bit_length()
    return (
        (0, "RUN_DETECTOR", 0),
        (1, "DETECT_RISING", 0),
        (2, "DETECT_FALLING", 0),
        (3, "DETECT_PULSES", 1),
        (4, "PULSE_POLARITY", 1),
        (5, "PULSE_LENGTH", clock_mhz, bits),
        (11, "RUN_GENERATOR", 0),
        (12, "GENERATOR_POLARITY", 1),
        (13, "GENERATOR_INTERVAL", clock_mhz, bits),
        (14, "GENERATOR_LENGTH", clock_mhz // 2, bits),
        (15, "INJECT_ON_RISING", 0),
        (16, "INJECT_ON_FALLING", 0),
    )


def declare(module: Module, rows: Rows, access: Access = Access.READ_WRITE, note: str = "") -> Iterator[Register]:
    """Yield registers of a module that share their access and their note."""
    for address, name, default, *bits in rows:
        yield Register(module, address, name, default, access, note, *bits)


def system_registers(system: SystemInfo) -> Iterator[Register]:
    """Yield the registers of system information; only a camera with an ADC has that clock."""
    adc_clock: Rows = ((4, "ADC_CLOCK_MHZ", system.adc_clock_mhz),) if system.adc_clock_mhz else ()
    rows: Rows = (
        (0, "LOGIC_VERSION", system.logic_version),
        (1, "CHIP_IDENTIFIER", system.chip_id),
        (2, "DEVICE_IS_MASTER", int(system.timestamp_master)),
        (3, "LOGIC_CLOCK_MHZ", system.logic_clock_mhz),
        *adc_clock,
        (5, "USB_CLOCK_MHZ", system.usb_clock_mhz),
        (6, "CLOCK_DEVIATION_THOUSANDTHS", system.clock_deviation),
        (7, "LOGIC_PATCH", system.logic_patch),
    )
    return declare(Module.SYSTEM, rows, Access.READ_ONLY)


def imu_type_registers(imu_unit: int) -> Iterator[Register]:
    """Yield the registers that identify the inertial unit, by its number in `imu_samples`."""
    return declare(Module.IMU, ((0, "TYPE", imu_unit), (1, "ORIENTATION", 0)), Access.READ_ONLY, "0: no IMU")


def shared_registers(
    system: SystemInfo, imu_unit: int, statistics: type[Enum], *, drops_events_on_stall: bool
) -> Iterator[Register]:
    """Yield the registers that all models have; `statistics`: the counters, see `RegisterFile.count`."""
    multiplexer: Rows = (
        (0, "RUN", 0),
        (1, "TIMESTAMP_RUN", 0),
        (2, "TIMESTAMP_RESET", 0),
        (3, "RUN_CHIP", 0),
        (4, "DROP_EXTINPUT_ON_STALL", 1),
        (5, "DROP_DVS_ON_STALL", int(drops_events_on_stall)),
    )
    yield from declare(Module.MULTIPLEXER, multiplexer)
    for module in (Module.MULTIPLEXER, Module.DVS):
        yield from declare(module, ((80, "HAS_STATISTICS", 1),), Access.READ_ONLY)
    yield from imu_type_registers(imu_unit)
    yield from declare(Module.EXTERNAL_INPUT, ((10, "HAS_GENERATOR", 1),), Access.READ_ONLY)
    yield from declare(Module.EXTERNAL_INPUT, _external_input(system.logic_clock_mhz), note="logic clock cycles")
    yield from system_registers(system)
    yield Register(Module.USB, 0, "RUN")
    delay: Rows = ((1, "EARLY_PACKET_DELAY", 1000 * system.usb_clock_mhz, 20 + system.usb_clock_mhz.bit_length()),)
    yield from declare(Module.USB, delay, note="USB clock cycles")
    for statistic in statistics:
        module, upper = statistic.value
        halves: Rows = ((upper, f"{statistic.name}_UPPER", 0), (upper + 1, f"{statistic.name}_LOWER", 0))
        yield from declare(module, halves, Access.READ_ONLY, "half of a 64-bit counter")


class RegisterFile:
    """Values of the declared registers."""

    def __init__(self, declared: Iterator[Register]) -> None:
        self._declared = {(r.module.value, r.address): r for r in declared}
        self.power_on()

    def power_on(self) -> None:
        """Set every register to its power-on value."""
        self._values = {key: register.default for key, register in self._declared.items()}

    def __iter__(self) -> Iterator[Register]:
        return iter(self._declared.values())

    def name_of(self, module: int, address: int) -> str:
        """Return the name of a register; "parameter" for one that does not exist."""
        register = self._declared.get((module, address))
        return "parameter" if register is None else register.name

    def read(self, module: int, address: int) -> int:
        """Return the 32-bit value; 0 for a register that does not exist."""
        return self._values.get((module, address), 0)

    def write(self, module: int, address: int, value: int) -> None:
        """Store the register's bits of a value; ignored if it is read-only or does not exist."""
        register = self._declared.get((module, address))
        if register is not None and register.access is Access.READ_WRITE:
            self._values[module, address] = value & (1 << register.bits) - 1

    def count(self, statistic: Enum, value: int) -> None:
        """Set a 64-bit counter, whose value is its (module, address), as the logic does; ignored if there is none."""
        module, upper = statistic.value
        if (module, upper) in self._declared:
            self._values[module, upper] = value >> 32 & 0xFFFFFFFF
            self._values[module, upper + 1] = value & 0xFFFFFFFF


@dataclass(frozen=True)
class RunGate:
    """The run bits that control the data path."""

    timestamps: bool
    reset: bool
    words: bool
    events: bool

    @classmethod
    def of(cls, values: RegisterFile) -> RunGate:
        """Return the run bits in the registers."""
        run, timestamps, reset, chip = (bool(values.read(Module.MULTIPLEXER, k)) for k in range(4))
        words = run and timestamps and chip and bool(values.read(Module.USB, 0))
        return cls(timestamps, reset, words, words and bool(values.read(Module.DVS, 3)))
