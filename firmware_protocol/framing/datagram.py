"""No framing, for transports that preserve packet boundaries (ISO-TP, CFP on CAN, UDP). One push is one packet."""

from __future__ import annotations

from firmware_protocol.framing.deframer import DEFAULT_MAX_PAYLOAD, FrameError, StreamDeframer
from firmware_protocol.framing.kiss import checked, sealed


def frame(payload: bytes) -> bytes:
    """Return `payload` as it is."""
    return payload


def frame_sealed(payload: bytes) -> bytes:
    """Return `payload` followed by its CRC-32C, as CSP has it on CAN."""
    return sealed(payload)


class Deframer(StreamDeframer):
    """Deframer for whole packets of up to `max_payload` bytes, one in each push."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD) -> None:
        super().__init__()
        self._max_payload = max_payload

    def push(self, data: bytes) -> list[bytes]:
        """Process one packet."""
        self.counters.bytes_received += len(data)
        try:
            payload = self._decode(data)
            if len(payload) > self._max_payload:
                raise FrameError("too long")
        except FrameError as error:
            self.counters.bad(str(error), len(data))
            return []
        self.counters.good(len(data))
        return [payload]

    def _decode(self, data: bytes) -> bytes:
        return data


class SealedDeframer(Deframer):
    """The same for packets that end in their CRC-32C; for `header_bytes` see `kiss.checked`."""

    def __init__(self, max_payload: int = DEFAULT_MAX_PAYLOAD, header_bytes: int = 0) -> None:
        super().__init__(max_payload)
        self._header_bytes = header_bytes

    def _decode(self, data: bytes) -> bytes:
        return checked(data, self._header_bytes)
