"""KISS as libcsp puts it on a serial line: SLIP's escapes, a command byte, and a CRC-32C.

    frame     FEND  0x00  escaped( data, u32 BE CRC-32C of data )  FEND        FEND 0xC0, FESC 0xDB

Source: libcsp 2 (csp_if_kiss.c, csp_crc32.c). `data` is the CSP packet with its header, so the checksum covers the
header, as libcsp 2.1 does; its receiver also takes a checksum without the header, ours does not, since a flipped bit
in such a header would go unseen. libcsp starts each frame at a FEND of its own, so each frame has two.
"""

from __future__ import annotations

from firmware_protocol.framing.crc import crc32c
from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, DelimitedDeframer, FrameError
from firmware_protocol.framing.slip import escape, unescape

__all__ = ["Deframer", "checked", "frame", "sealed"]

FEND = 0xC0
_DATA = 0x00
_CRC_BYTES = 4


def sealed(data: bytes) -> bytes:
    """Return `data` with its CRC-32C behind it."""
    return data + crc32c(data).to_bytes(_CRC_BYTES, "big")


def checked(sealed_data: bytes) -> bytes:
    """Undo `sealed`. Raises FrameError when the checksum does not fit."""
    data, crc = sealed_data[:-_CRC_BYTES], sealed_data[-_CRC_BYTES:]
    if len(crc) < _CRC_BYTES:
        raise FrameError("short")
    if crc32c(data) != int.from_bytes(crc, "big"):
        raise FrameError("crc")
    return data


def frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, both delimiters included."""
    return b"\xc0\x00" + escape(sealed(payload)) + b"\xc0"


class Deframer(DelimitedDeframer):
    """Gives the checked payloads of KISS frames of up to `max_payload` bytes."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(FEND, 1 + 2 * (max_payload + _CRC_BYTES))
        self._max_payload = max_payload

    def decode(self, piece: bytes) -> bytes:
        """Undo the escapes of one piece and check it."""
        if piece[0] != _DATA:
            raise FrameError("command")
        payload = checked(unescape(piece[1:]))
        if len(payload) > self._max_payload:
            raise FrameError("too long")
        return payload
