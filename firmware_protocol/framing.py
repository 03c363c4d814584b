"""The framings of packets: COBS, SLIP, KISS, that of F Prime, and none for transports of whole packets.

A deframer detects frames in a stream of bytes that may be damaged. With a delimiter, the stream is split at each one; a
piece between two delimiters is a frame, and an empty piece is ignored. The division of the stream into calls of `push`
affects neither results nor counts. Every byte has one fate:

    received = in frames (with their delimiters, and idle delimiters) + skipped (in refused pieces) + pending

A deframer holds at most one frame of the greatest length; a longer piece is refused and skipped to the next delimiter.

Consistent Overhead Byte Stuffing (COBS): no zero inside a frame, one zero after it.

    frame     group  group  ...  0x00
    group     u8 code (1..255), then code - 1 bytes that are not zero

A group represents its bytes and then a zero, except for code 255 (254 bytes and no zero) and for the last group of the
frame. Cost: one byte, one more per 254 bytes without a zero, and the delimiter.

Source: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Trans. Networking 7(2), 1999.

SLIP (RFC 1055): a frame between END bytes, with END and ESC escaped inside.

    frame     END data... END        END 0xC0, ESC 0xDB
    in data   END -> ESC 0xDC        ESC -> ESC 0xDD

As in the RFC's sample, END also comes first, so that noise on an idle line damages no frame. An ESC before any other
byte is an error here (the RFC leaves it open): the frame is refused.

KISS as libcsp uses it on a serial line: SLIP's escapes, a command byte, and a CRC-32C.

    frame     FEND  0x00  escaped( data, u32 BE CRC-32C of data )  FEND        FEND 0xC0, FESC 0xDB

Source: libcsp 2 (csp_if_kiss.c, csp_crc32.c; both directions were run against its C code). `data` is the CSP packet
with its header. The checksum covers all of it, as libcsp writes it when built with CSP_21; built without, libcsp leaves
the header out. The receiver of libcsp accepts both. This one accepts the second only if it is given the length of the
header, since a flipped bit in such a header is not detected. libcsp starts each frame at a FEND of its own, so each has
two.

F Prime: a start word, a length, the data, a CRC-32. All big-endian, nothing escaped.

    0  u32  start word 0xDEADBEEF
    4  u32  n, length of the data
    8  n    data
    8+n u32 CRC-32 (zlib's) of start word, length and data

Source: F Prime (nasa/fprime), Svc/FprimeProtocol/docs/sdd.md; byte order and checksum from Svc/FramingProtocol/
FprimeProtocol.cpp and Utils/Hash/libcrc/CRC32.cpp of October 2024.

The start word may occur in the data too: it is valid only at the start of a frame. When a frame is damaged, the search
continues one byte after its start word, so a wrong length costs at most the frames that it spans, and a wait of at most
one frame of the greatest length.

No framing, for transports that preserve packet boundaries (ISO-TP, CFP on CAN, UDP). One push is one packet.
"""

from __future__ import annotations

import struct
import zlib
from abc import ABC, abstractmethod
from collections import Counter
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

DEFAULT_MAX_PAYLOAD = 8192
"""Longest payload of a frame in bytes, by default: twice the length that CRC-16 protects well."""


class FrameError(ValueError):
    """A frame is damaged. The message is the reason under which it is counted."""


@dataclass
class FrameCounters:
    """Counts of a deframer.

    Attributes
    ----------
    bytes_received : all bytes pushed.
    bytes_framed : bytes of good frames, and delimiters between frames.
    bytes_skipped : bytes that belong to no good frame.
    frames : good frames.
    refused : bad frames by reason.
    """

    bytes_received: int = 0
    bytes_framed: int = 0
    bytes_skipped: int = 0
    frames: int = 0
    refused: Counter[str] = field(default_factory=Counter)

    @property
    def pending(self) -> int:
        """Bytes that wait for the rest of their frame."""
        return self.bytes_received - self.bytes_framed - self.bytes_skipped

    def good(self, length: int) -> None:
        """Count a good frame of `length` bytes on the line."""
        self.frames += 1
        self.bytes_framed += length

    def bad(self, reason: str, length: int) -> None:
        """Count a refused frame of `length` bytes on the line."""
        self.refused[reason] += 1
        self.bytes_skipped += length


class StreamDeframer(ABC):
    """Receives bytes in any pieces and returns the payloads of complete, valid frames of up to `max_payload` bytes."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        self.counters = FrameCounters()
        self._max_payload = max_payload

    def decode(self, piece: bytes) -> bytes:
        """Return the payload of the bytes of a frame (not empty). Raises FrameError if it is damaged."""
        return piece

    def _decoded(self, piece: bytes, length: int) -> bytes | None:
        """Return the payload of a frame that took `length` bytes on the line, counted; None if it is damaged."""
        try:
            payload = self.decode(piece)
            if len(payload) > self._max_payload:
                raise FrameError("too long")
        except FrameError as error:
            self.counters.bad(str(error), length)
            return None
        self.counters.good(length)
        return payload

    @abstractmethod
    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""


class DelimitedDeframer(StreamDeframer, ABC):
    """Splits the stream at one delimiter byte.

    Parameters
    ----------
    delimiter : byte that occurs in no frame.
    max_frame : longest frame in bytes on the line, without delimiters.
    max_payload : longest payload in bytes.
    """

    def __init__(self, delimiter: int, max_frame: int, max_payload: int) -> None:
        super().__init__(max_payload)
        self._delimiter = bytes([delimiter])
        self._max_frame = max_frame
        self._begun = b""
        self._skipping = False

    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""
        self.counters.bytes_received += len(data)
        pieces = data.split(self._delimiter)
        if len(pieces) == 1:
            self._begin(self._begun + data)
            return []
        pieces[0] = self._begun + pieces[0]
        self._begun = b""
        last = pieces.pop()
        payloads = [payload for piece in pieces if (payload := self._finish(piece)) is not None]
        self._begin(last)
        return payloads

    def _begin(self, piece: bytes) -> None:
        """Store the head of a frame, or skip it when it has grown too long."""
        if not self._skipping and len(piece) > self._max_frame:
            self._skipping = True
            self.counters.refused["too long"] += 1
        if self._skipping:
            self.counters.bytes_skipped += len(piece)
            piece = b""
        self._begun = piece

    def _finish(self, piece: bytes) -> bytes | None:
        """Decode a piece that a delimiter has ended."""
        if self._skipping:
            self._skipping = False
            self.counters.bytes_skipped += len(piece) + 1
            return None
        if not piece:
            self.counters.bytes_framed += 1
            return None
        if len(piece) > self._max_frame:
            self.counters.bad("too long", len(piece) + 1)
            return None
        return self._decoded(piece, len(piece) + 1)


_COBS_DELIMITER = 0x00
_LONGEST_RUN = 254
_CODES = [bytes([code]) for code in range(256)]


def cobs_longest(payload_bytes: int) -> int:
    """Return the most bytes on the line for a payload of that length, without the delimiter."""
    return payload_bytes + payload_bytes // _LONGEST_RUN + 1


def _groups(run: bytes) -> bytes:
    """Encode a run without zeros that is longer than one group holds."""
    starts = range(0, len(run), _LONGEST_RUN)
    return b"".join(_CODES[len(part) + 1] + part for part in (run[at : at + _LONGEST_RUN] for at in starts))


def cobs_encode(payload: bytes) -> bytes:
    """Return `payload` without zeros and without a delimiter."""
    runs = payload.split(b"\0")
    last = runs.pop()
    # A full group represents no zero, so a run that ends with one needs an empty group for it.
    parts = [
        _CODES[len(run) + 1] + run if len(run) < _LONGEST_RUN else _groups(run) + b"\1" * (len(run) % _LONGEST_RUN == 0)
        for run in runs
    ]
    parts.append(_groups(last) if last else b"\1")
    return b"".join(parts)


def cobs_decode(piece: bytes) -> bytes:
    """Decode the result of `cobs_encode`. Raises FrameError if a group exceeds the piece or a zero is inside."""
    if b"\0" in piece:
        raise FrameError("zero inside")
    parts = []
    at, end = 0, len(piece)
    while at < end:
        code = piece[at]
        parts.append(piece[at + 1 : at + code])
        at += code
        if code <= _LONGEST_RUN and at < end:
            parts.append(b"\0")
    if at != end:
        raise FrameError("group too long")
    return b"".join(parts)


def cobs_frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, delimiter included."""
    return cobs_encode(payload) + b"\0"


class CobsDeframer(DelimitedDeframer):
    """Deframer of COBS frames of up to `max_payload` bytes. COBS detects few errors: the packet has a CRC."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(_COBS_DELIMITER, cobs_longest(max_payload), max_payload)

    def decode(self, piece: bytes) -> bytes:
        """Undo the stuffing of one piece."""
        return cobs_decode(piece)


_END, _ESC = b"\xc0", b"\xdb"
_ESCAPED_END, _ESCAPED_ESC = b"\xdb\xdc", b"\xdb\xdd"


def _escape(data: bytes) -> bytes:
    """Return `data` with END and ESC escaped."""
    return data.replace(_ESC, _ESCAPED_ESC).replace(_END, _ESCAPED_END)


def _unescape(piece: bytes) -> bytes:
    """Return the data of `_escape`. Raises FrameError for an ESC that is not followed by one of its two codes."""
    escapes = piece.count(_ESC)
    if not escapes:
        return piece
    # Split at ESC: each part but the first then starts with an escaped byte.
    head, *parts = piece.split(_ESC)
    if any(part[:1] not in (b"\xdc", b"\xdd") for part in parts):
        raise FrameError("escape")
    return head + b"".join((_END if part[0] == 0xDC else _ESC) + part[1:] for part in parts)


def slip_frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, both delimiters included."""
    return _END + _escape(payload) + _END


class SlipDeframer(DelimitedDeframer):
    """Deframer of SLIP frames of up to `max_payload` bytes. SLIP detects no errors: the packet has a CRC."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(_END[0], 2 * max_payload, max_payload)

    def decode(self, piece: bytes) -> bytes:
        """Remove the escapes of one piece."""
        return _unescape(piece)


_KISS_DATA = 0x00
_CRC_BYTES = 4
_CASTAGNOLI_REFLECTED = 0x82F63B78
_CRC_ROW = 64


def _crc_tables() -> npt.NDArray[np.uint32]:
    """Return the remainder of each byte at each place of a row, before the rest of the row, (_CRC_ROW, 256)."""
    byte = np.arange(256, dtype=np.uint32)
    for _ in range(8):
        odd = (byte & 1).astype(bool)
        byte >>= 1
        byte[odd] ^= _CASTAGNOLI_REFLECTED
    tables = np.empty((_CRC_ROW, 256), np.uint32)
    tables[-1] = byte
    for place in range(_CRC_ROW - 2, -1, -1):
        tables[place] = byte[tables[place + 1] & 0xFF] ^ (tables[place + 1] >> 8)
    return tables


_CRC_TABLES = _crc_tables()
_FIRST, _SECOND, _THIRD, _FOURTH = (table.tolist() for table in _CRC_TABLES[:4])
_CRC_BYTE_TABLE: list[int] = _CRC_TABLES[-1].tolist()
_CRC_PLACES = np.arange(_CRC_ROW)


def crc32c(data: bytes) -> int:
    """Return the CRC-32C (Castagnoli) of `data`, as libcsp and iSCSI compute it.

    Whole rows of 64 bytes go at once: the remainder of a row is the exclusive or of one table entry per byte and place,
    which numpy gathers for all rows; only the register passed from row to row is a loop.
    """
    register, begun = 0xFFFFFFFF, len(data) % _CRC_ROW
    for byte in data[:begun]:
        register = _CRC_BYTE_TABLE[(register ^ byte) & 0xFF] ^ (register >> 8)
    rows = np.frombuffer(data, np.uint8, offset=begun) if len(data) > begun else np.empty(0, np.uint8)
    remainders = np.bitwise_xor.reduce(_CRC_TABLES[_CRC_PLACES, rows.reshape(-1, _CRC_ROW)], axis=1)
    for remainder in remainders.tolist():
        register = (
            remainder
            ^ _FIRST[register & 0xFF]
            ^ _SECOND[register >> 8 & 0xFF]
            ^ _THIRD[register >> 16 & 0xFF]
            ^ _FOURTH[register >> 24]
        )
    return register ^ 0xFFFFFFFF


def sealed(data: bytes) -> bytes:
    """Return `data` followed by its CRC-32C."""
    return data + crc32c(data).to_bytes(_CRC_BYTES, "big")


def checked(sealed_data: bytes, header_bytes: int = 0) -> bytes:
    """Return the data of `sealed`; a checksum without the first `header_bytes` is valid too. Raises FrameError."""
    data, crc = sealed_data[:-_CRC_BYTES], sealed_data[-_CRC_BYTES:]
    if len(crc) < _CRC_BYTES:
        raise FrameError("short")
    sent = int.from_bytes(crc, "big")
    if crc32c(data) != sent and not (header_bytes and crc32c(data[header_bytes:]) == sent):
        raise FrameError("crc")
    return data


def kiss_frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, both delimiters included."""
    return _END + bytes([_KISS_DATA]) + _escape(sealed(payload)) + _END


class KissDeframer(DelimitedDeframer):
    """Deframer of KISS frames of up to `max_payload` bytes, checked; for `header_bytes` see `checked`."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD, header_bytes: int = 0) -> None:
        super().__init__(_END[0], 1 + 2 * (max_payload + _CRC_BYTES), max_payload)
        self._header_bytes = header_bytes

    def decode(self, piece: bytes) -> bytes:
        """Remove the escapes of one piece and check it."""
        if piece[0] != _KISS_DATA:
            raise FrameError("command")
        return checked(_unescape(piece[1:]), self._header_bytes)


_FPRIME_START = b"\xde\xad\xbe\xef"
_FPRIME_HEADER = struct.Struct(">4sI")


def fprime_frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`."""
    head = _FPRIME_HEADER.pack(_FPRIME_START, len(payload)) + payload
    return head + zlib.crc32(head).to_bytes(_CRC_BYTES, "big")


class FPrimeDeframer(StreamDeframer):
    """Deframer of F Prime frames of up to `max_payload` bytes; it returns checked payloads."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(max_payload)
        self._held = b""

    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""
        self.counters.bytes_received += len(data)
        held = self._held + data
        payloads: list[bytes] = []
        at = 0
        while (start := held.find(_FPRIME_START, at)) >= 0:
            at = self._skip(at, start)
            end = self._end(held, start)
            if end is None:
                break
            at = self._check(held, start, end, payloads)
        else:
            # Up to three bytes may be the beginning of a start word.
            at = self._skip(at, max(at, len(held) - len(_FPRIME_START) + 1))
        self._held = held[at:]
        return payloads

    def _skip(self, at: int, to: int) -> int:
        self.counters.bytes_skipped += to - at
        return to

    def _end(self, held: bytes, start: int) -> int | None:
        """Return the end of the frame at `start`; `start` itself for an impossible length; None if it is incomplete."""
        if len(held) < start + _FPRIME_HEADER.size:
            return None
        length = _FPRIME_HEADER.unpack_from(held, start)[1]
        if length > self._max_payload:
            return start
        end: int = start + _FPRIME_HEADER.size + length + _CRC_BYTES
        return end if len(held) >= end else None

    def _check(self, held: bytes, start: int, end: int, payloads: list[bytes]) -> int:
        """Accept or refuse the frame at `start`; return the offset at which the search continues."""
        if end == start:
            self.counters.bad("too long", 1)
            return start + 1
        if zlib.crc32(held[start : end - _CRC_BYTES]) != int.from_bytes(held[end - _CRC_BYTES : end], "big"):
            self.counters.bad("crc", 1)
            return start + 1
        self.counters.good(end - start)
        payloads.append(held[start + _FPRIME_HEADER.size : end - _CRC_BYTES])
        return end


class PacketDeframer(StreamDeframer):
    """Deframer for whole packets of up to `max_payload` bytes, one in each push."""

    def push(self, data: bytes) -> list[bytes]:
        """Process one packet."""
        self.counters.bytes_received += len(data)
        payload = self._decoded(data, len(data))
        return [] if payload is None else [payload]


class SealedPacketDeframer(PacketDeframer):
    """Deframer for whole packets that end in their CRC-32C; for `header_bytes` see `checked`."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD, header_bytes: int = 0) -> None:
        super().__init__(max_payload)
        self._header_bytes = header_bytes

    def decode(self, piece: bytes) -> bytes:
        """Check one packet."""
        return checked(piece, self._header_bytes)
