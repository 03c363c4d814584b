"""Registers of Prophesee's sensors, as far as they are alike: 32 bits each, at byte addresses in steps of 4.

    9008   bit 0 time runs        9028   bit 1 no output
    array control of the sensor   bit 10 pixels run

A sensor adds its addresses, its power-on values and the effects of writes.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import numpy.typing as npt

Form = Literal["evt2", "evt21", "evt21-legacy", "evt3"]
"""Form of the words that leave a sensor."""

_TIME = 0x9008
_OUTPUT = 0x9028
_TIME_RUNS = 1 << 0
_PIXELS_RUN = 1 << 10
_NO_OUTPUT = 1 << 1


class NoRegister(LookupError):
    """There is no register at an address."""


@dataclass(frozen=True)
class SensorSurroundings(ABC):
    """Readings of a sensor's own instruments.

    Attributes
    ----------
    lowest_celsius, celsius_per_count : temperature at which the thermometer has the value 0, and its step.
    counts_per_us : counts of the refractory period in a microsecond.
    celsius : temperature of the chip.
    lux : light on the chip; the scene's light is not available here.
    dead_time_us : refractory period at the biases of a camera that was just opened.
    """

    lowest_celsius: ClassVar[float]
    celsius_per_count: ClassVar[float]
    counts_per_us: ClassVar[float]
    celsius: float = 35.0
    lux: float = 100.0
    dead_time_us: float = 100.0

    @property
    def adc(self) -> int:
        """Value of the thermometer, 0 to 1023."""
        return min(max(round((self.celsius - self.lowest_celsius) / self.celsius_per_count), 0), 1023)

    @property
    @abstractmethod
    def light_count(self) -> int:
        """Count of the light meter."""

    def dead_time_count(self, factor: float = 1.0) -> int:
        """Count of the refractory period, multiplied by `factor` by biases."""
        return min(round(self.counts_per_us * self.dead_time_us * factor), (1 << 28) - 1)


class ChipRegisters(ABC):
    """The register file of a sensor, from power-on, and the effects of its registers.

    Parameters
    ----------
    count : number of registers.
    biases : register of each bias, and its value at the factory or when a driver opens it, by Prophesee's names.
    power_on_values : of the registers that are not 0 at power-on.
    """

    array_control: ClassVar[int]
    bias_bits: ClassVar[int]

    def __init__(self, count: int, biases: Mapping[str, tuple[int, int]], power_on_values: Mapping[int, int]) -> None:
        self._words = np.zeros(count, np.uint32)
        self._bias_registers, self._power_on_values = biases, power_on_values
        self.power_on()

    def power_on(self) -> None:
        """Set every register to its power-on value."""
        self._words[:] = 0
        for address, value in self._power_on_values.items():
            self._set(address, value)

    def read(self, address: int) -> int:
        """Return a register's value; raises NoRegister."""
        return self[address]

    @abstractmethod
    def write(self, address: int, value: int) -> None:
        """Write a register, and apply its effect within the sensor; raises NoRegister."""

    def __getitem__(self, address: int) -> int:
        """Return the value written last; raises NoRegister."""
        return int(self._words[self._place(address)])

    def words(self, address: int, count: int) -> npt.NDArray[np.uint32]:
        """Return (count,) registers from `address` on."""
        place = self._place(address)
        return self._words[place : place + count]

    @property
    def currents(self) -> dict[str, int]:
        """Value of each bias, by Prophesee's names."""
        return {name: self[address] & self.bias_bits for name, (address, _) in self._bias_registers.items()}

    @property
    def bias_steps(self) -> dict[str, int]:
        """Steps of each bias away from its value at the factory or at open, by Prophesee's names."""
        return {name: value - self._bias_registers[name][1] for name, value in self.currents.items()}

    @property
    @abstractmethod
    def form(self) -> Form:
        """Form of the words that leave the sensor."""

    @property
    def time_runs(self) -> bool:
        """True if the sensor's clock runs."""
        return bool(self[_TIME] & _TIME_RUNS)

    @property
    def running(self) -> bool:
        """True if events leave the sensor."""
        return self.time_runs and bool(self[self.array_control] & _PIXELS_RUN) and not self[_OUTPUT] & _NO_OUTPUT

    @property
    @abstractmethod
    def has_trigger(self) -> bool:
        """True if the trigger input is on."""

    def _set(self, address: int, value: int) -> None:
        self._words[self._place(address)] = value & 0xFFFF_FFFF

    def _place(self, address: int) -> int:
        """Return the place of a register in the file; raises NoRegister."""
        if address & 3 or not 0 <= address < 4 * len(self._words):
            raise NoRegister(f"no register at 0x{address:08X}")
        return address // 4
