"""KISS as libcsp uses it on a serial line: SLIP's escapes, a command byte, and a CRC-32C.

    frame     FEND  0x00  escaped( data, u32 BE CRC-32C of data )  FEND        FEND 0xC0, FESC 0xDB

Source: libcsp 2 (csp_if_kiss.c, csp_crc32.c; both directions were run against its C code). `data` is the CSP packet
with its header. The checksum covers all of it, as libcsp writes it when built with CSP_21; built without, libcsp leaves
the header out. The receiver of libcsp accepts both. This one accepts the second only if it is given the length of the
header, since a flipped bit in such a header is not detected. libcsp starts each frame at a FEND of its own, so each has
two.
"""

from __future__ import annotations

from firmware_protocol.framing.crc import crc32c
from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, DelimitedDeframer, FrameError
from firmware_protocol.framing.slip import escape, unescape

FEND = 0xC0
_DATA = 0x00
_CRC_BYTES = 4


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


def frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, both delimiters included."""
    return b"\xc0\x00" + escape(sealed(payload)) + b"\xc0"


class Deframer(DelimitedDeframer):
    """Deframer of KISS frames of up to `max_payload` bytes, checked; for `header_bytes` see `checked`."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD, header_bytes: int = 0) -> None:
        super().__init__(FEND, 1 + 2 * (max_payload + _CRC_BYTES))
        self._max_payload = max_payload
        self._header_bytes = header_bytes

    def decode(self, piece: bytes) -> bytes:
        """Remove the escapes of one piece and check it."""
        if piece[0] != _DATA:
            raise FrameError("command")
        payload = checked(unescape(piece[1:]), self._header_bytes)
        if len(payload) > self._max_payload:
            raise FrameError("too long")
        return payload
