"""Inputs of an FMU: from a CSV file over its time, or from the frames of a CAN bus as they come."""

from __future__ import annotations

import csv
import importlib
import math
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Protocol

from emulator.dynamics.failures import DynamicsError
from emulator.dynamics.mapping import Bus, Mapping
from emulator.light import MachineLacks
from emulator.tables.text_file import TextFileError, read_text

__all__ = ["CanInputs", "FileInputs", "Inputs", "opened_inputs"]

_MOST_BYTES = 64 << 20
_MOST_FRAMES = 1000  # a step, so that a flood does not hold the flight up
_TIME = "time_s"


class Inputs(Protocol):
    """What gives inputs."""

    @property
    def names(self) -> tuple[str, ...]:
        """Variables that may be set."""

    def at(self, t_s: float) -> dict[str, float]:
        """Return what is to be set before the step from `t_s`."""


class FileInputs:
    """Inputs of a CSV file: a row holds from its time on; raises DynamicsError."""

    def __init__(self, file: Path) -> None:
        try:
            lines = list(csv.reader(read_text(file, _MOST_BYTES).splitlines()))
        except TextFileError as error:
            raise DynamicsError(f"{file} {error}") from error
        if not lines or lines[0][:1] != [_TIME] or len(lines[0]) < 2:
            raise DynamicsError(f"{file}: line 1 must name the columns: {_TIME}, then variables of the FMU")
        self.names = tuple(lines[0][1:])
        self._rows = [_numbers(file, k, line, len(lines[0])) for k, line in enumerate(lines[1:], 2) if line]
        for k, (one, other) in enumerate(zip(self._rows, self._rows[1:], strict=False), 3):
            if other[0] <= one[0]:
                raise DynamicsError(f"{file}: row {k}: times must ascend, {other[0]:g} comes after {one[0]:g}")
        self._next = 0

    def at(self, t_s: float) -> dict[str, float]:
        """Return the newest row's values when they are new at `t_s`, which ascends."""
        due: dict[str, float] = {}
        while self._next < len(self._rows) and self._rows[self._next][0] <= t_s + 1e-9:
            due = dict(zip(self.names, self._rows[self._next][1:], strict=True))
            self._next += 1
        return due


def _numbers(file: Path, line: int, cells: list[str], columns: int) -> list[float]:
    try:
        values = [float(cell) for cell in cells]
    except ValueError as error:
        raise DynamicsError(f"{file}: line {line}: {error}") from error
    if len(values) != columns or not all(map(math.isfinite, values)):
        raise DynamicsError(f"{file}: line {line}: expected {columns} finite numbers")
    return values


class CanInputs:
    """Inputs from the frames that a bus of python-can has received.

    Attributes
    ----------
    unusable : frames of known ids that were too short, or held no finite number.
    """

    def __init__(self, bus: Any, told: Bus) -> None:
        self._bus, self._signals = bus, told.signals
        self.names = tuple(signal.variable for signal in told.signals)
        self.unusable = 0

    def at(self, t_s: float) -> dict[str, float]:
        """Return the newest value of each variable whose frame came since the last call."""
        due: dict[str, float] = {}
        for _ in range(_MOST_FRAMES):
            if (frame := self._bus.recv(0)) is None:
                break
            for signal in self._signals:
                if signal.id == frame.arbitration_id:
                    self._take(signal.variable, signal.value(bytes(frame.data)), due)
        return due

    def _take(self, variable: str, value: float | None, due: dict[str, float]) -> None:
        if value is None or not math.isfinite(value):
            self.unusable += 1
        else:
            due[variable] = value


@contextmanager
def opened_inputs(mapping: Mapping, folder: Path) -> Iterator[list[Inputs]]:
    """Yield the inputs that a mapping names; files lie in `folder`. Raises DynamicsError and MachineLacks."""
    inputs: list[Inputs] = [FileInputs(folder / mapping.file.path)] if mapping.file else []
    if mapping.can is None:
        yield inputs
        return
    can = importlib.import_module("can")
    try:
        bus = can.Bus(interface=mapping.can.interface, channel=mapping.can.channel)
    except Exception as error:  # each backend of python-can has errors of its own
        told = f"CAN bus {mapping.can.interface}:{mapping.can.channel}: {error}"
        raise MachineLacks(told) from error
    with bus:
        yield [*inputs, CanInputs(bus, mapping.can)]
