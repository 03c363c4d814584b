"""The mapping file: which variables of an FMU are the pose, what is set at the start, and where inputs come from.

step_s = 0.01
position_m = ["x", "y", "z"]              # variables, or numbers
q_world_from_body = ["qw", "qx", "qy", "qz"]
[start]
mass_kg = 1000.0
[file]                                    # columns named in the first line: time_s, then variables
path = "commands.csv"
[can]
interface = "socketcan"
channel = "vcan0"
[[can.signals]]
variable = "thrust_n"
id = 0x120
format = "<f"                             # of Python's struct module, from byte `at` on

Names are those of the FMU's modelDescription.xml.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass, field
from pathlib import Path

from emulator.dynamics.failures import DynamicsError
from emulator.tables.text_file import TextFileError, read_text
from emulator.tables.toml_text import TomlError, read_toml
from emulator.tables.typed_table import TableError, convert

__all__ = ["Bus", "InputFile", "Mapping", "Signal", "load_mapping"]

_MOST_BYTES = 1 << 20
_MOST_ID = 0x1FFF_FFFF


@dataclass(frozen=True)
class Signal:
    """A number in a CAN frame that is an input of the FMU: `scale` times what `format` reads, plus `offset`."""

    variable: str
    id: int
    format: str = "<f"
    at: int = 0
    scale: float = 1.0
    offset: float = 0.0

    def __post_init__(self) -> None:
        if not 0 <= self.id <= _MOST_ID:
            raise ValueError(f"id must be 0 to 0x{_MOST_ID:x}, got {self.id}")
        try:
            values = struct.unpack(self.format, bytes(struct.calcsize(self.format)))
        except struct.error as error:
            raise ValueError(f"format {self.format!r}: {error}") from error
        if len(values) != 1 or not isinstance(values[0], int | float):
            raise ValueError(f'format {self.format!r} must read one number, such as "<f" or ">h"')
        if not 0 <= self.at <= 64 - struct.calcsize(self.format):
            raise ValueError(f"at must be 0 to {64 - struct.calcsize(self.format)}, got {self.at}")

    def value(self, data: bytes) -> float | None:
        """Return the number that a frame's data hold; None where they are too short."""
        if len(data) < self.at + struct.calcsize(self.format):
            return None
        return float(struct.unpack_from(self.format, data, self.at)[0]) * self.scale + self.offset


@dataclass(frozen=True)
class Bus:
    """A CAN bus of python-can, and what its frames hold."""

    interface: str
    channel: str
    signals: tuple[Signal, ...]


@dataclass(frozen=True)
class InputFile:
    """A CSV file of inputs over time; each value holds until the next one. The path is from the mapping's folder."""

    path: str


@dataclass(frozen=True)
class Mapping:
    """What evstim has to know of an FMU.

    Attributes
    ----------
    position_m : three variables or numbers, m in the world of the rig's scene.
    q_world_from_body : four variables or numbers, scalar first.
    step_s : time from one pose to the next.
    body : number of the live path, 0 the camera.
    start : values that are set before the FMU is initialised, by variable.
    """

    position_m: tuple[str | float, str | float, str | float]
    q_world_from_body: tuple[str | float, str | float, str | float, str | float] = (1.0, 0.0, 0.0, 0.0)
    step_s: float = 0.01
    body: int = 0
    start: dict[str, float] = field(default_factory=dict)
    file: InputFile | None = None
    can: Bus | None = None

    def __post_init__(self) -> None:
        if not 1e-5 <= self.step_s <= 10:
            raise ValueError(f"step_s must be 1e-5 to 10, got {self.step_s:g}")
        if not 0 <= self.body < 1 << 16:
            raise ValueError(f"body must be 0 to 65535, got {self.body}")

    @property
    def outputs(self) -> tuple[str, ...]:
        """Variables that are read after each step."""
        return tuple(one for one in (*self.position_m, *self.q_world_from_body) if isinstance(one, str))


def load_mapping(path: Path) -> Mapping:
    """Return a mapping file; raises DynamicsError."""
    try:
        return convert(read_toml(read_text(path, _MOST_BYTES)), Mapping)
    except TextFileError as error:
        raise DynamicsError(f"{path} {error}") from error
    except TomlError as error:
        raise DynamicsError(error.at(str(path))) from error
    except TableError as error:
        raise DynamicsError(f"{path}: {'.'.join(map(str, error.path))}: {error}") from error
