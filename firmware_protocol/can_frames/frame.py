"""One frame of a CAN bus, its bus time, and the follow-up of a SYNC.

The notation of frames is that of `candump` and `cansend` of can-utils:

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

The bus time of a frame counts its stuff bits exactly; `BusShare` limits the bus load to a share of the time.
Bits of a classic frame with n data bytes (ISO 11898-1; the bits after the CRC are never stuffed):

    standard   SOF 1 | identifier 11 | RTR 1 | IDE 1 | r0 1 | DLC 4 | data 8n | CRC 15    stuffed: 34 + 8n
    extended   SOF 1 | identifier 11 | SRR 1 | IDE 1 | identifier 18 | RTR 1 | r1 r0 2 | DLC 4 | data | CRC   54 + 8n
    both       CRC delimiter 1 | ACK 1 | ACK delimiter 1 | end of frame 7 | intermission 3     fixed: 13

After five equal bits the sender inserts one of the opposite kind, which counts as the first of the next five: at most
floor((stuffed - 1) / 4) of them. CAN FD does so up to the end of its data. Then follow 4 bits of stuff count and 17 (up
to 16 data bytes) or 21 bits of CRC, with a fixed stuff bit before the first and after every fourth bit:

    standard   SOF 1 | identifier 11 | RRS 1 | IDE 1 | FDF 1 | res 1 | BRS 1      at the nominal rate
    extended   SOF 1 | identifier 11 | SRR 1 | IDE 1 | identifier 18 | RRS 1 | FDF 1 | res 1 | BRS 1
    both       ESI 1 | DLC 4 | data 8n | stuff count 4 | CRC 17 or 21 | fixed stuff 6 or 7     at the data rate with BRS
               CRC delimiter 1 | ACK 1 | ACK delimiter 1 | end of frame 7 | intermission 3     at the nominal rate

An error frame has the flags of all nodes, 6 to 12 bits, a delimiter of 8 and the intermission of 3; 23 bits count.

Dynamic stuff bits of FD count at the rate of the part that they are in.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from functools import cached_property, lru_cache

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
    identifier : 11 bits, or 29 bits when `extended`; of an error frame, the class bits of linux/can/error.h.
    data : at most 8 bytes; with `fd` one of the lengths of `FD_LENGTHS`.
    extended : 29-bit identifier.
    fd : CAN FD.
    brs : the data are sent at the second, faster bit rate; only with `fd`.
    error : a report of the controller, not a frame of a node: bus-off, error-passive and so on.
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
        match = _TEXT.fullmatch(text.strip())
        if match is None:
            raise FrameError(f"{text!r} is not a CAN frame such as 123#1122, 00000123#1122 or 123##1AABB")
        digits, flags = match[1], match[2]
        data = bytes.fromhex(match[3].replace(".", ""))
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
    """One follow-up message: the SYNC's `counter`, 0 to 255, and the sender's clock when it left, 0 to 2^56 - 1 ns."""

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


_TAIL_BITS = 13
_ERROR_BITS = 12 + 8 + 3
_RUN = 5
_CRC15 = 0x4599


@dataclass(frozen=True)
class FrameBits:
    """Bits of one frame, intermission included: at the nominal rate, and at the data rate (0 in a classic frame)."""

    nominal: int
    fast: int = 0


@dataclass(frozen=True)
class BitRates:
    """Bits per second of a bus; `fast` for the data of CAN FD frames that switch."""

    nominal: int = 1_000_000
    fast: int = 5_000_000

    def __post_init__(self) -> None:
        if not 1_000 <= self.nominal <= 1_000_000:
            raise ValueError(f"nominal bit rate must be 1000 to 1000000 bit/s, got {self.nominal}")
        if not self.nominal <= self.fast <= 20_000_000:
            raise ValueError(f"fast bit rate must be the nominal {self.nominal} to 20000000 bit/s, got {self.fast}")

    def duration_ns(self, bits: FrameBits) -> int:
        """Return the duration of these bits."""
        return -(-bits.nominal * 1_000_000_000 // self.nominal) + -(-bits.fast * 1_000_000_000 // self.fast)


@lru_cache(maxsize=64)  # it is called when a frame is offered, and again when it is sent
def frame_bits(frame: Frame) -> FrameBits:
    """Return the bits that `frame` takes on the bus, its own stuff bits counted exactly."""
    if frame.error:
        return FrameBits(_ERROR_BITS)
    if frame.fd:
        return _fd_bits(frame)
    head, bits = _classic_head(frame)
    body = (head << 8 * len(frame.data)) | int.from_bytes(frame.data, "big")
    bits += 8 * len(frame.data)
    stuffed = (body << 15) | crc15(body, bits)
    bits += 15
    return FrameBits(bits + _stuff_bits(stuffed, bits, _START)[0] + _TAIL_BITS)


def crc15(value: int, bits: int) -> int:
    """Return the CRC-15 of CAN over the low `bits` of `value`, first bit highest; zeros in front change nothing."""
    crc = 0
    for byte in value.to_bytes((bits + 7) // 8, "big"):
        crc = ((crc << 8) & 0x7FFF) ^ _CRC_TABLE[(crc >> 7) ^ byte]
    return crc


def _classic_head(frame: Frame) -> tuple[int, int]:
    """Return SOF to DLC as a number, and the number of these bits."""
    n = len(frame.data)
    if not frame.extended:
        return (frame.identifier << 7) | n, 19
    base, extension = frame.identifier >> 18, frame.identifier & 0x3FFFF
    return (((base << 2 | 0b11) << 18 | extension) << 3) << 4 | n, 39


def _fd_bits(frame: Frame) -> FrameBits:
    if frame.extended:
        base, extension = frame.identifier >> 18, frame.identifier & 0x3FFFF
        head, head_bits = ((base << 2 | 0b11) << 18 | extension) << 4 | 0b0100 | int(frame.brs), 36
    else:
        head, head_bits = (frame.identifier << 5) | 0b00100 | int(frame.brs), 17
    body = (FD_LENGTHS.index(len(frame.data)) << 8 * len(frame.data)) | int.from_bytes(frame.data, "big")
    body_bits = 5 + 8 * len(frame.data)
    in_head, state = _stuff_bits(head, head_bits, _START)
    in_body, _ = _stuff_bits(body, body_bits, state)
    nominal = head_bits + in_head + _TAIL_BITS
    tail = 4 + 17 + 6 if len(frame.data) <= 16 else 4 + 21 + 7  # stuff count, CRC and fixed stuff bits
    fast = body_bits + in_body + tail
    return FrameBits(nominal, fast) if frame.brs else FrameBits(nominal + fast)


# The state of the stuffing is (last bit, length of its run 1..5) as 5 * bit + run - 1. The bus idles recessive (1), and
# the first bit of a frame is dominant (0), so the run before it does not matter.
_START = 5


def _next_bit(state: int, bit: int) -> tuple[int, int]:
    """Return the state after one more bit, and true if a stuff bit followed it."""
    last, run = divmod(state, _RUN)
    run = run + 2 if bit == last else 1
    # The stuff bit is the first of its own run.
    return (_RUN * (1 - bit), 1) if run == _RUN else (_RUN * bit + run - 1, 0)


def _byte_table() -> list[list[tuple[int, int]]]:
    table = []
    for start in range(2 * _RUN):
        row = []
        for byte in range(256):
            state, stuffed = start, 0
            for shift in range(7, -1, -1):
                state, inserted = _next_bit(state, byte >> shift & 1)
                stuffed += inserted
            row.append((stuffed, state))
        table.append(row)
    return table


def _crc_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 7
        for _ in range(8):
            crc = ((crc << 1) ^ _CRC15) & 0x7FFF if crc & 0x4000 else crc << 1
        table.append(crc)
    return table


_STUFF_TABLE = _byte_table()
_CRC_TABLE = _crc_table()


def _stuff_bits(value: int, bits: int, state: int) -> tuple[int, int]:
    """Return the number of stuff bits in the low `bits` of `value`, first bit highest, and the state after them."""
    stuffed = 0
    odd = bits % 8
    for shift in range(odd - 1, -1, -1):
        state, inserted = _next_bit(state, value >> (bits - odd + shift) & 1)
        stuffed += inserted
    for byte in (value & ((1 << (bits - odd)) - 1)).to_bytes(bits // 8, "big"):
        inserted, state = _STUFF_TABLE[state][byte]
        stuffed += inserted
    return stuffed, state


class BusShare:
    """Keeps the load of a bus at or below a share of its time.

    A bucket of bus time: it fills at `share` of real time up to `depth_ns`, and every frame takes its duration out of
    it. Ordinary frames may leave while it is not empty. Urgent ones (SYNC, heartbeat) always may; the time that they
    take is missing for the ordinary ones. Over T the load is at most share + (depth_ns + one frame) / T.

    Parameters
    ----------
    rates : bit rates of the bus.
    share : 0 to 1.
    depth_ns : bus time that may be made up after a pause; it covers the period at which the sender runs.
    """

    def __init__(self, rates: BitRates, share: float, depth_ns: int = 1_000_000) -> None:
        if not 0 < share <= 1:
            raise ValueError(f"share must be above 0 and at most 1, got {share}")
        if depth_ns <= 0:
            raise ValueError(f"depth_ns must be positive, got {depth_ns}")
        self._rates = rates
        # The bucket counts millionths of ns: integers, so that nothing drifts.
        self._share_ppm = round(share * 1_000_000)
        self._full = depth_ns * 1_000_000
        self._level = 0
        self._seen_ns: int | None = None

    def has_room(self, now_ns: int) -> bool:
        """Return true if an ordinary frame may leave at `now_ns`, which never goes back."""
        self._fill(now_ns)
        return self._level > 0

    def spend(self, frame: Frame, now_ns: int) -> int:
        """Count a frame that leaves, or one of another node that was received; return its duration, ns."""
        self._fill(now_ns)
        duration_ns = self._rates.duration_ns(frame_bits(frame))
        self._level -= duration_ns * 1_000_000
        return duration_ns

    def _fill(self, now_ns: int) -> None:
        if self._seen_ns is not None:
            self._level = min(self._full, self._level + max(0, now_ns - self._seen_ns) * self._share_ppm)
        self._seen_ns = now_ns if self._seen_ns is None else max(self._seen_ns, now_ns)
