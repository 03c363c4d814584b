"""One frame of a CAN bus, in the notation of `candump` and `cansend` of can-utils, and the follow-up of a SYNC.

    123#1122           classic, 11-bit identifier, two bytes
    00000123#          classic, 29-bit identifier (always eight digits), no data
    123##1AABB...      CAN FD; the digit after ## is 1 with a switch of the bit rate, 0 without (flags of canfd_frame)
    20000040#00...     an error frame of SocketCAN: bit 29 of the identifier, the class in the lower bits

Source: can-utils `lib.c` (parse_canframe, fprint_canframe) and linux/can.h, linux/can/error.h. Remote frames are not
modelled: CANopen advises against them and CAN FD has none.

The follow-up of a SYNC carries the sender's clock at the moment when that SYNC was on the bus. A SYNC has the highest
priority and still waits for a frame that is being sent, up to 0.16 ms at 1 Mbit/s. The sender of the SYNC measures its
transmission time and sends it in another frame:

    u8 counter of the SYNC it belongs to (0 where the bus counts none) | u56 ns of the sender's clock

Little-endian, 8 bytes; 2^56 ns are 2.2 years. A receiver pairs its own time of the SYNC with this one.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property

from firmware_protocol.can_frames.canopen import ObjectError

FD_LENGTHS = (0, 1, 2, 3, 4, 5, 6, 7, 8, 12, 16, 20, 24, 32, 48, 64)
"""The data lengths that a CAN FD frame can have, by DLC (ISO 11898-1)."""

_ERROR_FLAG = 0x2000_0000
_TEXT = re.compile(r"([0-9A-Fa-f]{3}|[0-9A-Fa-f]{8})#(?:#([0-9A-Fa-f]))?((?:[0-9A-Fa-f]{2}\.?)*)")


class FrameError(ValueError):
    """Values that no CAN frame can have."""


@dataclass(frozen=True)
class Frame:
    """A frame as it goes over a bus.

    Attributes
    ----------
    identifier
        11 bits, or 29 bits when `extended`; of an error frame, the class bits of linux/can/error.h.
    data
        At most 8 bytes; with `fd` one of the lengths of `FD_LENGTHS`.
    extended
        29-bit identifier.
    fd
        CAN FD.
    brs
        The data are sent at the second, faster bit rate; only with `fd`.
    error
        A report of the controller, not a frame of a node: bus-off, error-passive and so on.
    """

    identifier: int
    data: bytes = b""
    extended: bool = False
    fd: bool = False
    brs: bool = False
    error: bool = False

    def __post_init__(self) -> None:
        limit = 1 << (29 if self.extended or self.error else 11)
        if not 0 <= self.identifier < limit:
            raise FrameError(f"identifier {self.identifier:#x} is not below {limit:#x}")
        if self.brs and not self.fd:
            raise FrameError("only a CAN FD frame can switch its bit rate")
        if self.error and self.fd:
            raise FrameError("an error frame is not a CAN FD frame")
        if len(self.data) > 8 and (not self.fd or len(self.data) not in FD_LENGTHS):
            kind = "CAN FD" if self.fd else "classic CAN"
            raise FrameError(f"no {kind} frame has {len(self.data)} data bytes")

    @cached_property
    def arbitration(self) -> tuple[int, bool, int]:
        """Sort key of arbitration: the lower base identifier first, then standard before extended, then the rest."""
        if self.extended:
            return self.identifier >> 18, True, self.identifier & 0x3FFFF
        return self.identifier, False, 0

    @classmethod
    def parse(cls, text: str) -> Frame:
        """Read the notation that `cansend` reads and `candump -L` prints; raises FrameError."""
        found = _TEXT.fullmatch(text.strip())
        if found is None:
            raise FrameError(f"{text!r} is not a CAN frame such as 123#1122, 00000123#1122 or 123##1AABB")
        digits, flags, data = found[1], found[2], bytes.fromhex(found[3].replace(".", ""))
        identifier = int(digits, 16)
        error = len(digits) == 8 and bool(identifier & _ERROR_FLAG)
        return cls(
            identifier & ~_ERROR_FLAG if error else identifier,
            data,
            extended=len(digits) == 8 and not error,
            fd=flags is not None,
            brs=flags is not None and bool(int(flags, 16) & 1),
            error=error,
        )

    def __str__(self) -> str:
        flagged = self.identifier | _ERROR_FLAG if self.error else self.identifier
        head = f"{flagged:08X}" if self.extended or self.error else f"{flagged:03X}"
        return f"{head}##{int(self.brs)}{self.data.hex().upper()}" if self.fd else f"{head}#{self.data.hex().upper()}"


def fd_length(n: int) -> int:
    """Return the shortest CAN FD data length of at least `n` bytes; raises FrameError above 64."""
    for length in FD_LENGTHS:
        if length >= n:
            return length
    raise FrameError(f"no CAN FD frame has {n} data bytes")


_TIME_BYTES = 7


@dataclass(frozen=True)
class FollowUp:
    """One follow-up message.

    Attributes
    ----------
    counter
        Counter of the SYNC, 0 to 255.
    sent_ns
        Sender's clock when the SYNC left, ns, 0 to 2^56 - 1.
    """

    counter: int
    sent_ns: int

    def __post_init__(self) -> None:
        if not 0 <= self.counter <= 0xFF:
            raise ValueError(f"counter must be 0 to 255, got {self.counter}")
        if not 0 <= self.sent_ns < 1 << 8 * _TIME_BYTES:
            raise ValueError(f"sent_ns must be 0 to 2^56 - 1, got {self.sent_ns}")

    def __bytes__(self) -> bytes:
        return bytes([self.counter]) + self.sent_ns.to_bytes(_TIME_BYTES, "little")

    @classmethod
    def parse(cls, data: bytes) -> FollowUp:
        """Read a frame's data; raises ObjectError."""
        if len(data) != 1 + _TIME_BYTES:
            raise ObjectError(f"a follow-up has 8 bytes, not {len(data)}")
        return cls(data[0], int.from_bytes(data[1:], "little"))
