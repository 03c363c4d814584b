"""Prophesee's sensors as their drivers show them on Linux (V4L2), and the registers that their settings write.

The kernel module in `c/v4l2` makes the devices of a sensor that a program describes, and gives that program the
settings of clients. The messages, in the machine's order of octets (`evstim_v4l2.h` has them in C):

    message 1, sensor      32 name, 32 serial, 6 u32: width, height, octets of a buffer, crop, formats, controls;
                           4 u32 pixel formats, 4 u32 codes on the bus, 16 controls
    a control              4 s64: minimum, maximum, step, initial; 4 u32: id, type, values, 0; 32 name
    message 2, words       the words
    message 3, answer      s32, 0 or -errno
    request                u32 kind, u32 id, s64 value, 74 u32 values
        1 stream           value 1 on, 0 off
        2 format           id: which of the sensor's formats
        3 control          id; value, or the values
        4 crop             values 0 to 3: x, y, width, height

    controls               bias_*, erc_enable, erc_rate, and where there is no crop: roi_reset, roi_roni, roi_set

roi_set is a number n and 18 windows of x, y, width, height, of which the first n count.

Sources: prophesee-ai/linux-sensor-drivers (names, numbers and limits of the controls, formats, codes, the registers of
windows and rate control); OpenEB 5.1.1, hal_psee_plugins, boards/v4l2 (what a client needs; it takes biases of an
imx636 as offsets from the initial ones). Different from these: roi_set is an array of u32, and there a type of its own.
Inferred: biases and rate control of an imx636, whose public driver has none, with the registers' limits.
"""

from __future__ import annotations

import errno
import struct
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import NamedTuple

from firmware_protocol.prophesee.registers import Form
from firmware_protocol.prophesee.treuzell import RegisterBus

_SENSOR = struct.Struct("=I32s32s6I4I4I")
_CONTROL = struct.Struct("=4q4I32s")
_MOST_FORMATS, _MOST_CONTROLS = 4, 16
_REQUEST = struct.Struct("=IIq74I")
REQUEST_BYTES = _REQUEST.size
WORDS_HEADER = struct.pack("=I", 2)
"""Octets before the words in a message."""

_USER = 0x0098_0900
_RATE = _USER | 0x1001
_RATE_ON = _USER | 0x1002
_BIAS = _USER | 0x3000
_RESET = _USER | 0x4001
_WINDOWS = _USER | 0x4004
_OUTSIDE = _USER | 0x4006
_MOST_RATE_HZ = 200_000_000
MOST_WINDOWS = 18
"""Windows of the control roi_set."""

_Writes = Sequence[tuple[int, int]]


class RequestKind(IntEnum):
    """Kinds of requests."""

    STREAM = 1
    FORMAT = 2
    CONTROL = 3
    CROP = 4


class Request(NamedTuple):
    """A request of a client, as the kernel gives it to the program."""

    kind: int
    id: int
    value: int
    values: tuple[int, ...]

    @classmethod
    def parse(cls, data: bytes) -> Request:
        """Read a request; raises ValueError for another size."""
        if len(data) != REQUEST_BYTES:
            raise ValueError(f"a request has {REQUEST_BYTES} bytes, got {len(data)}")
        numbers = _REQUEST.unpack(data)
        return cls(numbers[0], numbers[1], numbers[2], numbers[3:])


def answer(error: int = 0) -> bytes:
    """Return the message that ends a request; `error`: an errno, 0 if it was executed."""
    return struct.pack("=Ii", 3, -error)


class ControlType(IntEnum):
    """Types of controls, by V4L2's numbers."""

    INTEGER = 1
    BOOLEAN = 2
    BUTTON = 4
    INTEGER64 = 5
    U32 = 0x102


@dataclass(frozen=True)
class Control:
    """A control: its V4L2 id and type, its limits, and the number of its values."""

    name: str
    id: int
    type: ControlType = ControlType.INTEGER
    minimum: int = 0
    maximum: int = 0
    initial: int = 0
    values: int = 1

    def __bytes__(self) -> bytes:
        step = 0 if self.type is ControlType.BUTTON else 1
        limits = self.minimum, self.maximum, step, self.initial
        return _CONTROL.pack(*limits, self.id, self.type, self.values, 0, self.name.encode("ascii"))


class PixelFormat(NamedTuple):
    """A format of the words: V4L2's four letters, its code on the media bus, and the sensor's own name."""

    letters: bytes
    bus_code: int
    form: Form


EVT3_FORMAT = PixelFormat(b"PSE3", 0x5302, "evt3")
_NO_FORMAT = PixelFormat(bytes(4), 0, "evt3")


class Window(NamedTuple):
    """A rectangle of pixels."""

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class RateRegisters:
    """Registers of a rate control; `on` and `off` switch it; a period has `period_us`."""

    period: int
    events: int
    period_us: int
    initial_events: int
    on: _Writes
    off: _Writes


@dataclass(frozen=True)
class NodeSensor:
    """A sensor as its driver shows it.

    Attributes
    ----------
    name : beginning of the entity's name, by which clients know the sensor.
    size : (width, height), pixels.
    biases : controls of the biases, with the register of each.
    select : Function that writes windows, and whether events outside of them leave, to the registers.
    has_windows : True: clients give windows by roi_set; False: a single window, by the crop.
    """

    name: str
    size: tuple[int, int]
    formats: tuple[PixelFormat, ...]
    biases: Mapping[Control, int]
    bias_bits: int
    rate: RateRegisters
    select: Callable[[RegisterBus, Sequence[Window], bool], None]
    has_windows: bool

    @property
    def controls(self) -> tuple[Control, ...]:
        """All controls, in the order in which clients list them."""
        initial_hz = self.rate.initial_events * 1_000_000 // self.rate.period_us
        rate = (
            Control("erc_rate", _RATE, ControlType.INTEGER64, 0, _MOST_RATE_HZ, initial_hz),
            Control("erc_enable", _RATE_ON, ControlType.BOOLEAN, 0, 1),
        )
        windows = (
            Control("roi_reset", _RESET, ControlType.BUTTON),
            Control("roi_set", _WINDOWS, ControlType.U32, 0, 0xFFFF_FFFF, 0, 1 + 4 * MOST_WINDOWS),
            Control("roi_roni", _OUTSIDE, ControlType.BOOLEAN, 0, 1),
        )
        return (*rate, *self.biases, *(windows if self.has_windows else ()))

    def description(self, serial: str, buffer_bytes: int) -> bytes:
        """Return the message that makes the devices; `serial` is the name of the card that clients read."""
        formats = [*self.formats, *[_NO_FORMAT] * (_MOST_FORMATS - len(self.formats))]
        controls = b"".join(map(bytes, self.controls)).ljust(_MOST_CONTROLS * _CONTROL.size, b"\0")
        counts = buffer_bytes, not self.has_windows, len(self.formats), len(self.controls)
        letters = [int.from_bytes(pixel_format.letters, "little") for pixel_format in formats]
        codes = [pixel_format.bus_code for pixel_format in formats]
        name = f"{self.name} evstim".encode("ascii")
        return (
            _SENSOR.pack(1, name, serial.encode("ascii", "replace")[:31], *self.size, *counts, *letters, *codes)
            + controls
        )


class NodeSettings:
    """The settings that clients make, written to the registers of `bus`."""

    def __init__(self, sensor: NodeSensor, bus: RegisterBus) -> None:
        self.sensor = sensor
        self.bus = bus
        self._rate_hz = next(control.initial for control in sensor.controls if control.id == _RATE)
        self._windows: list[Window] = []
        self._outside = False

    def apply(self, request: Request) -> None:
        """Execute a request of kind CONTROL or CROP; raises OSError with the errno for the client where it cannot."""
        if request.kind == RequestKind.CROP:
            self._select([Window(*request.values[:4])])
            return
        bias = next((control for control in self.sensor.biases if control.id == request.id), None)
        if bias is not None:
            if not bias.minimum <= request.value <= bias.maximum:
                raise OSError(errno.ERANGE, f"{bias.name} is {bias.minimum} to {bias.maximum}, got {request.value}")
            address = self.sensor.biases[bias]
            flags = self.bus.read_register(address) & ~self.sensor.bias_bits
            self.bus.write_register(address, flags | request.value)
        elif request.id == _RATE:
            self._rate_hz = request.value
            self._set_rate()
        elif request.id == _RATE_ON:
            self._set_rate()
            self._write(self.sensor.rate.on if request.value else self.sensor.rate.off)
        elif request.id == _RESET:
            self._select([])
        elif request.id == _WINDOWS:
            self._select(_windows(request.values, self.sensor.size))
        elif request.id == _OUTSIDE:
            self._outside = bool(request.value)
            self._select(self._windows)
        else:
            raise OSError(errno.EINVAL, f"no control {request.id:#x}")

    def _set_rate(self) -> None:
        rate = self.sensor.rate
        self._write(((rate.period, rate.period_us), (rate.events, self._rate_hz * rate.period_us // 1_000_000)))

    def _select(self, windows: Sequence[Window]) -> None:
        self._windows = list(windows)
        # No window at all is the whole sensor, also where events outside of windows are wanted, as in the drivers.
        selected = windows or [Window(0, 0, *self.sensor.size)]
        self.sensor.select(self.bus, selected, self._outside and bool(windows))

    def _write(self, writes: _Writes) -> None:
        for address, value in writes:
            self.bus.write_register(address, value)


def _windows(values: Sequence[int], size: tuple[int, int]) -> list[Window]:
    """Return the windows of roi_set; raises OSError for one that is not on the sensor."""
    count, *places = values
    if count > MOST_WINDOWS:
        raise OSError(errno.EINVAL, f"{count} windows, at most {MOST_WINDOWS}")
    windows = [Window(*places[4 * k : 4 * k + 4]) for k in range(count)]
    for window in windows:
        if window.x + window.width > size[0] or window.y + window.height > size[1]:
            raise OSError(errno.EINVAL, f"{window} is not on {size[0]}x{size[1]} pixels")
    return windows


def bias_controls(
    registers: Mapping[str, tuple[int, int]], limits: Mapping[str, tuple[int, int]]
) -> Mapping[Control, int]:
    """Return the controls of biases with their registers, from register and initial value, and from limits, by name."""
    controls = {}
    for k, (name, bounds) in enumerate(limits.items()):
        address, initial = registers[name]
        controls[Control(f"bias_{name}", _BIAS + k, ControlType.INTEGER, *bounds, initial)] = address
    return controls
