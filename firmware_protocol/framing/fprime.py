"""The frame of F Prime: a start word, a length, the data, a CRC-32. All big-endian, nothing escaped.

    0  u32  start word 0xDEADBEEF
    4  u32  n, length of the data
    8  n    data
    8+n u32 CRC-32 (zlib's) of start word, length and data

Source: F Prime (nasa/fprime), Svc/FprimeProtocol/docs/sdd.md; byte order and checksum from Svc/FramingProtocol/
FprimeProtocol.cpp and Utils/Hash/libcrc/CRC32.cpp of October 2024.

The start word may occur in the data too: it is valid only at the start of a frame. When a frame is damaged, the search
continues one byte after its start word, so a wrong length costs at most the frames that it spans, and a wait of at most
one frame of the greatest length.
"""

from __future__ import annotations

import struct

from firmware_protocol.framing.crc import crc32
from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, StreamDeframer

_START = b"\xde\xad\xbe\xef"
_HEADER = struct.Struct(">4sI")
_CRC_BYTES = 4


def frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`."""
    head = _HEADER.pack(_START, len(payload)) + payload
    return head + crc32(head).to_bytes(_CRC_BYTES, "big")


class Deframer(StreamDeframer):
    """Deframer of F Prime frames of up to `max_payload` bytes; it returns checked payloads."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__()
        self._max_payload = max_payload
        self._held = b""

    def push(self, data: bytes) -> list[bytes]:
        """Process the next bytes of the stream; return the payloads of the frames that they complete, in order."""
        self.counters.bytes_received += len(data)
        held = self._held + data
        payloads: list[bytes] = []
        at = 0
        while (start := self._find_start(held, at)) is not None:
            at = start
            end = self._end(held, start)
            if end is None:
                break
            at = self._check(held, start, end, payloads)
        else:
            # Up to three bytes may be the beginning of a start word.
            at = self._skip(at, max(at, len(held) - len(_START) + 1))
        self._held = held[at:]
        return payloads

    def _find_start(self, held: bytes, at: int) -> int | None:
        """Skip to the next start word."""
        start = held.find(_START, at)
        if start < 0:
            return None
        return self._skip(at, start)

    def _skip(self, at: int, to: int) -> int:
        self.counters.bytes_skipped += to - at
        return to

    def _end(self, held: bytes, start: int) -> int | None:
        """Return the end of the frame at `start`; `start` itself for an impossible length; None if it is incomplete."""
        if len(held) < start + _HEADER.size:
            return None
        length = _HEADER.unpack_from(held, start)[1]
        if length > self._max_payload:
            return start
        end: int = start + _HEADER.size + length + _CRC_BYTES
        return end if len(held) >= end else None

    def _check(self, held: bytes, start: int, end: int, payloads: list[bytes]) -> int:
        """Accept or refuse the frame at `start`; return the offset at which the search continues."""
        if end == start:
            self.counters.bad("too long", 1)
            return start + 1
        if crc32(held[start : end - _CRC_BYTES]) != int.from_bytes(held[end - _CRC_BYTES : end], "big"):
            self.counters.bad("crc", 1)
            return start + 1
        self.counters.good(end - start)
        payloads.append(held[start + _HEADER.size : end - _CRC_BYTES])
        return end
