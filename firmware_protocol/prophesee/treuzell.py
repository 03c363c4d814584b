"""Treuzell, the control protocol of Prophesee's boards: requests on a bulk OUT endpoint, answers on a bulk IN one.

A frame, little-endian; an answer is at most 1024 bytes:

    0  u32  property    bit 30 a write, bit 31 (answers) it failed, 0x80000000 alone: no such property
    4  u32  size of the payload
    8       payload

    property                 request's payload          answer's payload
    72     serial            -                          u64
    79     release           -                          u32, 0x00MMmmpp
    7A     build date        -                          u64, Unix time, s
    10000  devices           -                          u32, their number
    10001  name              u32 device                 u32 device, text, NUL
    10003  compatible with   u32 device                 u32 device, texts, a NUL after each
    10102  read registers    u32 device, address, n     u32 device, address, n x u32
    40010102  write them     u32 device, address, n x u32    u32 device, address

Boards of the generation before have frames of registers without a size, and answer with the value that is read or was
written:

    55  u32 address                 u32 55, address, value
    56  u32 address, u32 value      u32 56, address, value

Registers that failed: u32 device, address, errno. Each request gets one answer, also an invalid one: a frame without a
header is answered as an unknown property. Device 0 is the sensor; some boards have a thermometer as device 1.

Sources: OpenEB 5.1.1 (tz_control_frame, tz_libusb_board_command); neuromorphic_drivers, which reads one register at a
time; Prophesee's treuzell-kernel-module, f_treuzell.c (frames without a size). neuromorphic_drivers sends these to an
EVK3 HD, and ignores the answers.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Protocol

MOST_ANSWER_BYTES = 1024
UNKNOWN = 0x8000_0000
FAILED = 0x8000_0000
WRITE = 0x4000_0000
EINVAL, ENODEV = 22, 19

_HEADER = struct.Struct("<II")
_SHORT_FRAMES = ((8, struct.pack("<I", 0x55)), (12, struct.pack("<I", 0x56)))
_MOST_WORDS = (MOST_ANSWER_BYTES - _HEADER.size) // 4 - 2


class Property(IntEnum):
    """Properties that the board supports."""

    SERIAL = 0x72
    RELEASE = 0x79
    BUILD_DATE = 0x7A
    DEVICES = 0x1_0000
    NAME = 0x1_0001
    COMPATIBLE = 0x1_0003
    READ_REGISTERS = 0x1_0102
    WRITE_REGISTERS = WRITE | 0x1_0102


class Failed(Exception):
    """A request that the board understands and cannot execute; `payload` is the answer's."""

    def __init__(self, payload: bytes) -> None:
        super().__init__("the request cannot be executed")
        self.payload = payload


@dataclass(frozen=True)
class Frame:
    """A request or an answer."""

    property: int
    payload: bytes = b""

    @classmethod
    def parse(cls, data: bytes) -> Frame:
        """Read a frame; raises ValueError if its size is not that of the transfer."""
        if len(data) < _HEADER.size:
            raise ValueError(f"a frame has at least {_HEADER.size} bytes, got {len(data)}")
        name, size = _HEADER.unpack_from(data)
        if size != len(data) - _HEADER.size:
            raise ValueError(f"the frame announces {size} bytes of payload and has {len(data) - _HEADER.size}")
        return cls(name, data[_HEADER.size :])

    def __bytes__(self) -> bytes:
        return _HEADER.pack(self.property, len(self.payload)) + self.payload


class RegisterBus(Protocol):
    """The registers of a device."""

    def read_register(self, address: int) -> int:
        """Return a register's value; raises LookupError if there is none."""

    def write_register(self, address: int, value: int) -> None:
        """Write a register; raises LookupError if there is none."""


@dataclass(frozen=True)
class BoardFacts:
    """Identity data of the board; `short_frames`: True if it has frames without a size as well."""

    serial: int
    release: int
    build_unix_s: int
    short_frames: bool = False


@dataclass(frozen=True)
class BoardDevice:
    """A device of the board: its name, the names by which OpenEB finds a driver, and its registers."""

    name: str
    compatible: tuple[str, ...]
    registers: RegisterBus


class Board:
    """Answers requests; it has no state between two of them. The first of `devices` is the sensor."""

    def __init__(self, facts: BoardFacts, devices: Sequence[BoardDevice]) -> None:
        self._devices = devices
        self._has_short_frames = facts.short_frames
        self._doing: dict[int, Callable[[bytes], bytes]] = {
            Property.SERIAL: lambda payload: _nothing(payload, struct.pack("<Q", facts.serial)),
            Property.RELEASE: lambda payload: _nothing(payload, struct.pack("<I", facts.release)),
            Property.BUILD_DATE: lambda payload: _nothing(payload, struct.pack("<Q", facts.build_unix_s)),
            Property.DEVICES: lambda payload: _nothing(payload, struct.pack("<I", len(devices))),
            Property.NAME: lambda payload: self._texts(payload, lambda device: (device.name,)),
            Property.COMPATIBLE: lambda payload: self._texts(payload, lambda device: device.compatible),
            Property.READ_REGISTERS: self._read,
            Property.WRITE_REGISTERS: self._write,
        }

    def answer(self, data: bytes) -> bytes:
        """Execute the request in a transfer's bytes and return the answer's."""
        if self._has_short_frames and (len(data), data[:4]) in _SHORT_FRAMES:
            return self._short(data)
        try:
            request = Frame.parse(data)
        except ValueError:
            return bytes(Frame(UNKNOWN))
        do = self._doing.get(request.property)
        if do is None:
            return bytes(Frame(UNKNOWN))
        try:
            return bytes(Frame(request.property, do(request.payload)))
        except Failed as failed:
            return bytes(Frame(request.property | FAILED, failed.payload))

    def _short(self, data: bytes) -> bytes:
        """Execute a request without a size; where there is no register, nothing is written, and 0 is read."""
        address, *values = struct.unpack_from(f"<{len(data) // 4 - 1}I", data, 4)
        sensor = self._devices[0].registers
        try:
            for value in values:
                sensor.write_register(address, value)
            value = sensor.read_register(address)
        except LookupError:
            value = 0
        return data[:8] + struct.pack("<I", value)

    def _texts(self, payload: bytes, texts: Callable[[BoardDevice], Sequence[str]]) -> bytes:
        """Return the device that a request names, with texts of it, each with a NUL; raises Failed for no device."""
        number = int.from_bytes(payload[:4], "little")
        if len(payload) != 4 or number >= len(self._devices):
            raise Failed(payload[:4])
        return payload + "".join(f"{text}\0" for text in texts(self._devices[number])).encode("ascii")

    def _registers(self, payload: bytes) -> tuple[RegisterBus, tuple[int, ...]]:
        """Return the registers of the device that a request names, and its first three numbers; raises Failed."""
        if len(payload) < 12:
            raise Failed(struct.pack("<III", 0, 0, EINVAL))
        words = struct.unpack_from("<3I", payload)
        if words[0] >= len(self._devices):
            raise _failed(words, ENODEV)
        return self._devices[words[0]].registers, words

    def _read(self, payload: bytes) -> bytes:
        registers, words = self._registers(payload)
        _, address, count = words
        if len(payload) != 12 or not 1 <= count <= _MOST_WORDS:
            raise _failed(words, EINVAL)
        try:
            values = [registers.read_register(address + 4 * k) for k in range(count)]
        except LookupError:
            raise _failed(words, EINVAL) from None
        return payload[:8] + struct.pack(f"<{count}I", *values)

    def _write(self, payload: bytes) -> bytes:
        registers, words = self._registers(payload)
        if len(payload) % 4:
            raise _failed(words, EINVAL)
        for k, (value,) in enumerate(struct.iter_unpack("<I", payload[8:])):
            try:
                registers.write_register(words[1] + 4 * k, value)
            except LookupError:
                raise _failed(words, EINVAL) from None
        return payload[:8]


def _nothing(payload: bytes, answer: bytes) -> bytes:
    """Return `answer` to a request that needs no payload."""
    if payload:
        raise Failed(b"")
    return answer


def _failed(words: tuple[int, ...], errno: int) -> Failed:
    return Failed(struct.pack("<III", words[0], words[1], errno))
