"""A flight: an FMU is simulated step by step, in a process of its own, and the pose of each step is sent.

Inputs of the FMU come from a CSV file over its time, or from the frames of a CAN bus as they come. The mapping file has
the variables of the pose, the start values and the sources of inputs:

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

import csv
import importlib
import importlib.util
import math
import multiprocessing
import struct
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from signal import Signals
from typing import Annotated, Any

from msgspec import Meta

from emulator.dynamics.fmu_process import serve
from emulator.light import MachineLacks
from emulator.run.link_process import starting_a_process
from emulator.tables.toml_text import TextFileError, TomlError, read_text, read_toml
from emulator.tables.typed_table import TableError, convert
from firmware_protocol.bounds import Bounded
from firmware_protocol.pose_message import NOW, PoseMessage, PoseMessageError
from transports import Closing
from transports.needs import install_command
from transports.output_file import TemporaryFolder


class DynamicsError(Exception):
    """The FMU, its mapping or its inputs cannot be used; the message contains the required change."""


class FlightEnded(Exception):
    """The FMU failed during the flight; the message contains the time and the reason."""


_MOST_BYTES = 1 << 20
_MOST_ID = 0x1FFF_FFFF


@dataclass(frozen=True)
class Signal:
    """A number in a CAN frame that is an input of the FMU: `scale` times the value read by `format`, plus `offset`."""

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
    """A CAN bus of python-can, and the signals in its frames."""

    interface: str
    channel: str
    signals: tuple[Signal, ...]


@dataclass(frozen=True)
class InputFile:
    """A CSV file of inputs over time; each value holds until the next one. The path is from the mapping's folder."""

    path: str


@dataclass(frozen=True)
class Mapping(Bounded):
    """Mapping of an FMU's variables to a pose and inputs.

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
    step_s: Annotated[float, Meta(ge=1e-5, le=10)] = 0.01
    body: Annotated[int, Meta(ge=0, le=65535)] = 0
    start: dict[str, float] = field(default_factory=dict)
    file: InputFile | None = None
    can: Bus | None = None

    @property
    def outputs(self) -> tuple[str, ...]:
        """Variables that are read after each step."""
        return tuple(
            component for component in (*self.position_m, *self.q_world_from_body) if isinstance(component, str)
        )


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


_MOST_INPUT_BYTES = 64 << 20
_MOST_FRAMES = 1000  # a step, so that a flood does not hold the flight up
_TIME = "time_s"


class FileInputs:
    """Inputs of a CSV file: a row holds from its time on; raises DynamicsError."""

    def __init__(self, file: Path) -> None:
        try:
            lines = list(csv.reader(read_text(file, _MOST_INPUT_BYTES).splitlines()))
        except TextFileError as error:
            raise DynamicsError(f"{file} {error}") from error
        if not lines or lines[0][:1] != [_TIME] or len(lines[0]) < 2:
            raise DynamicsError(f"{file}: line 1 must name the columns: {_TIME}, then variables of the FMU")
        self.names = tuple(lines[0][1:])
        self._rows = [_numbers(file, k, line, len(lines[0])) for k, line in enumerate(lines[1:], 2) if line]
        for k, (row, other) in enumerate(zip(self._rows, self._rows[1:], strict=False), 3):
            if other[0] <= row[0]:
                raise DynamicsError(f"{file}: row {k}: times must ascend, {other[0]:g} comes after {row[0]:g}")
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
    """Inputs from the frames that a bus of python-can has received, but for those too short or without a number."""

    def __init__(self, bus: Any, table: Bus) -> None:
        self._bus, self._signals = bus, table.signals
        self.names = tuple(signal.variable for signal in table.signals)

    def at(self, t_s: float) -> dict[str, float]:
        """Return the newest value of each variable whose frame came since the last call."""
        due: dict[str, float] = {}
        for _ in range(_MOST_FRAMES):
            if (frame := self._bus.recv(0)) is None:
                break
            for signal in self._signals:
                value = signal.value(bytes(frame.data)) if signal.id == frame.arbitration_id else None
                if value is not None and math.isfinite(value):
                    due[signal.variable] = value
        return due


Inputs = FileInputs | CanInputs
"""Source of inputs: `names` of variables that may be set, and those that are due `at` a time."""


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
        message = f"CAN bus {mapping.can.interface}:{mapping.can.channel}: {error}"
        raise MachineLacks(message) from error
    with bus:
        yield [*inputs, CanInputs(bus, mapping.can)]


_UNIT_WITHIN = 0.01


_START_S = 120.0
_STEP_S = 30.0


class Fmu(Closing):
    """An initialised co-simulation FMU; use it in a `with` block.

    `step` sets the variables `inputs`; `outputs` has the present values of the mapping's outputs, by variable. Raises
    MachineLacks without fmpy; DynamicsError if the file is no FMU that can be used, or lacks a variable; FlightEnded if
    it fails or crashes when it starts.
    """

    def __init__(self, file: Path, mapping: Mapping, inputs: tuple[str, ...] = ()) -> None:
        if importlib.util.find_spec("fmpy") is None:
            raise MachineLacks(f"FMUs need fmpy:  {install_command('fmu')}")
        if not file.is_file():
            raise DynamicsError(f"{file}: no such file")
        self._file, self._names = file, list(dict.fromkeys(mapping.outputs))
        self._folder = TemporaryFolder("fmu")  # outlives a crash of the FMU
        context = multiprocessing.get_context("spawn")
        self._near, child_end = context.Pipe()
        self._process = context.Process(target=serve, args=(child_end,), name=f"FMU {file.name}", daemon=True)
        with starting_a_process(serve):
            self._process.start()
        child_end.close()
        where = {"file": str(file), "folder": self._folder.name}
        content = {**where, "start": mapping.start, "outputs": self._names, "inputs": list(inputs)}
        try:
            self.outputs = self._answer(content, _START_S, "when it starts")
        except BaseException:
            self.close()
            raise

    def step(self, t_s: float, step_s: float, inputs: dict[str, float]) -> None:
        """Set inputs and do one step from `t_s`; raises FlightEnded."""
        self.outputs = self._answer((t_s, step_s, inputs), _STEP_S, f"in its step from {t_s:g} s")

    def _answer(self, message: object, limit_s: float, moment: str) -> dict[str, float]:
        try:
            self._near.send(message)
            if not self._near.poll(limit_s):
                raise FlightEnded(f"{self._file}: the FMU does not answer within {limit_s:g} s {moment}")
            kind, content = self._near.recv()
        except (EOFError, OSError) as error:
            raise FlightEnded(f"{self._file}: the FMU crashed {moment} ({self._end()})") from error
        if kind == "wrong":
            raise DynamicsError(f"{self._file} {content}")
        if kind == "failed":
            raise FlightEnded(f"{self._file}: the FMU failed {moment}: {content}")
        return dict(zip(self._names, content, strict=True))

    def _end(self) -> str:
        self._process.join(10)
        code = self._process.exitcode
        return Signals(-code).name if code is not None and code < 0 else f"exit code {code}"

    def close(self) -> None:
        """End the process, and remove what it has unpacked."""
        self._near.close()
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._folder.cleanup()


@dataclass(frozen=True)
class Pace:
    """Duration and pacing of a flight.

    Attributes
    ----------
    seconds : of the FMU's time.
    stamped : whether poses carry the FMU's time as stream time; otherwise they hold from their arrival.
    waiting : waits until the flight has lasted so many seconds; returns whether it should go on.
    """

    seconds: float
    stamped: bool
    waiting: Callable[[float], bool]


@dataclass(frozen=True)
class FlightResult:
    """Result of a flight."""

    steps: int
    t_s: float
    last: PoseMessage


def fly(
    unit: Fmu, mapping: Mapping, inputs: Sequence[Inputs], pace: Pace, send: Callable[[PoseMessage], object]
) -> FlightResult:
    """Step the FMU until the time is over or `pace` ends the flight; raises FlightEnded."""
    steps, number = round(pace.seconds / mapping.step_s), 0
    pose = _pose(unit, mapping, number, pace)
    send(pose)
    while number < steps and pace.waiting((number + 1) * mapping.step_s):
        t_s = number * mapping.step_s
        values = {name: value for source in inputs for name, value in source.at(t_s).items()}
        unit.step(t_s, mapping.step_s, values)
        number += 1
        pose = _pose(unit, mapping, number, pace)
        send(pose)
    return FlightResult(number, number * mapping.step_s, pose)


def _pose(unit: Fmu, mapping: Mapping, number: int, pace: Pace) -> PoseMessage:
    """Return the present pose; raises FlightEnded where the FMU's numbers are no pose."""
    t_s = number * mapping.step_s
    wrong = [name for name in mapping.outputs if not math.isfinite(unit.outputs[name])]
    if wrong:
        raise FlightEnded(f"at {t_s:g} s the FMU gives {wrong[0]} = {unit.outputs[wrong[0]]}: no pose was sent for it")
    x, y, z = (_number(unit, component) for component in mapping.position_m)
    w, i, j, k = (_number(unit, component) for component in mapping.q_world_from_body)
    length = math.hypot(w, i, j, k)
    if abs(length - 1) > _UNIT_WITHIN:
        raise FlightEnded(f"at {t_s:g} s q_world_from_body has length {length:.4g}: a unit quaternion is needed")
    attitude = w / length, i / length, j / length, k / length
    t_ns = round(t_s * 1e9) if pace.stamped else NOW
    try:
        return PoseMessage(t_ns, (x, y, z), attitude, body=mapping.body, counter=number % (1 << 32))
    except PoseMessageError as error:
        raise FlightEnded(f"at {t_s:g} s: {error}") from error


def _number(unit: Fmu, component: str | float) -> float:
    return unit.outputs[component] if isinstance(component, str) else float(component)


def wall_clock(stop: Callable[[], bool]) -> Callable[[float], bool]:
    """Return a function that waits on the wall clock, from now on, until `stop` returns True."""
    begun_s = time.monotonic()

    def wait(t_s: float) -> bool:
        while (rest_s := begun_s + t_s - time.monotonic()) > 0 and not stop():
            time.sleep(min(rest_s, 0.1))
        return not stop()

    return wait
