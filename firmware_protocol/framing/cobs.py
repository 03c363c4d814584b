"""Consistent Overhead Byte Stuffing: no zero inside a frame, one zero after it.

    frame     group  group  ...  0x00
    group     u8 code (1..255), then code - 1 bytes that are not zero

A group represents its bytes and then a zero, except for code 255 (254 bytes and no zero) and for the last group of the
frame. Cost: one byte, one more per 254 bytes without a zero, and the delimiter.

Source: S. Cheshire and M. Baker, "Consistent Overhead Byte Stuffing", IEEE/ACM Trans. Networking 7(2), 1999.
"""

from __future__ import annotations

from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, DelimitedDeframer, FrameError

DELIMITER = 0x00
_LONGEST_RUN = 254
_CODES = [bytes([code]) for code in range(256)]


def longest(payload_bytes: int) -> int:
    """Return the most bytes on the line for a payload of that length, without the delimiter."""
    return payload_bytes + payload_bytes // _LONGEST_RUN + 1


def _groups(run: bytes) -> bytes:
    """Encode a run without zeros that is longer than one group holds."""
    starts = range(0, len(run), _LONGEST_RUN)
    return b"".join(_CODES[len(part) + 1] + part for part in (run[at : at + _LONGEST_RUN] for at in starts))


def encode(payload: bytes) -> bytes:
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


def decode(piece: bytes) -> bytes:
    """Decode the result of `encode`. Raises FrameError if a group exceeds the piece or a zero is inside."""
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


def frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, delimiter included."""
    return encode(payload) + b"\0"


class Deframer(DelimitedDeframer):
    """Deframer of COBS frames of up to `max_payload` bytes. COBS detects few errors: the packet has a CRC."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(DELIMITER, longest(max_payload))

    def decode(self, piece: bytes) -> bytes:
        """Undo the stuffing of one piece."""
        return decode(piece)
