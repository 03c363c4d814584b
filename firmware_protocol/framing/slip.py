"""SLIP (RFC 1055): a frame between END bytes, with END and ESC escaped inside.

    frame     END data... END        END 0xC0, ESC 0xDB
    in data   END -> ESC 0xDC        ESC -> ESC 0xDD

As in the RFC's sample, END also comes first, so that noise on an idle line damages no frame. An ESC before any other
byte is an error here (the RFC leaves it open): the frame is refused.
"""

from __future__ import annotations

from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, DelimitedDeframer, FrameError

END = 0xC0
_END, _ESC = b"\xc0", b"\xdb"
_ESCAPED_END, _ESCAPED_ESC = b"\xdb\xdc", b"\xdb\xdd"


def escape(data: bytes) -> bytes:
    """Return `data` with END and ESC escaped."""
    return data.replace(_ESC, _ESCAPED_ESC).replace(_END, _ESCAPED_END)


def unescape(piece: bytes) -> bytes:
    """Return the data of `escape`. Raises FrameError for an ESC that is not followed by one of its two codes."""
    escapes = piece.count(_ESC)
    if not escapes:
        return piece
    # Split at ESC: each part but the first then starts with an escaped byte.
    first, *rest = piece.split(_ESC)
    if any(part[:1] not in (b"\xdc", b"\xdd") for part in rest):
        raise FrameError("escape")
    return first + b"".join((_END if part[0] == 0xDC else _ESC) + part[1:] for part in rest)


def frame(payload: bytes) -> bytes:
    """Return the bytes that carry `payload`, both delimiters included."""
    return _END + escape(payload) + _END


class Deframer(DelimitedDeframer):
    """Deframer of SLIP frames of up to `max_payload` bytes. SLIP detects no errors: the packet has a CRC."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__(END, 2 * max_payload)
        self._max_payload = max_payload

    def decode(self, piece: bytes) -> bytes:
        """Remove the escapes of one piece."""
        payload = unescape(piece)
        if len(payload) > self._max_payload:
            raise FrameError("too long")
        return payload
