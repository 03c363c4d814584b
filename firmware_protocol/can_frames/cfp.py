"""The CAN fragmentation protocol of CSP version 2 (CFP 2): CSP packets in classic CAN frames with 29-bit identifiers.

Identifier:

    bit  28..27    26..13        12..7    6..5          4..2         1      0
         priority  destination   sender   packet count  frame count  begin  end

The data of the first frame start with the rest of the CSP header, big-endian, then come up to four bytes of the packet:

    bit  31..18   17..12             11..6         5..0
         source   destination port   source port   flags

All other frames carry eight bytes. Frame count is 0 in the first frame and counts modulo 8, packet count modulo 4: a
hole of exactly eight frames goes unseen, so that only the CRC-32C at the end of a CSP packet finds it. Source: libcsp,
`csp_if_can.h` and `csp_if_can.c` (csp_can2_tx, csp_can2_rx), October 2024; compared with what
csp_can2_tx, compiled, sends.

Here a packet is its bytes as on other carriers: the six bytes of the CSP header, then the data, CRC included.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame

__all__ = ["CFP_HEADER_BYTES", "CfpReceiver", "cfp_frames"]

CFP_HEADER_BYTES = 6
"""Of the CSP version 2 header."""

_FIRST_BYTES = 4
_CONNECTION = 0x1FFF_FFFF & ~0x1F  # priority, destination, sender and packet count: one packet under way each
_TIMEOUT_NS = 1_000_000_000  # PBUF_TIMEOUT_MS in csp_if_can_pbuf.c
_LONGEST_BYTES = 4096
_MOST_CONNECTIONS = 64


def cfp_frames(packet: bytes, sender: int, packet_count: int) -> list[Frame]:
    """Return the frames of a CSP packet, header first; `sender` is our address, of which six bits are told.

    Raises ValueError for less than a header.
    """
    if len(packet) < CFP_HEADER_BYTES:
        raise ValueError(f"a CSP packet has a header of {CFP_HEADER_BYTES} bytes, this has {len(packet)}")
    fixed = int.from_bytes(packet[:2], "big") << 13 | (sender & 0x3F) << 7 | (packet_count & 3) << 5
    first = packet[2 : CFP_HEADER_BYTES + _FIRST_BYTES]
    parts = [first, *(packet[i : i + 8] for i in range(CFP_HEADER_BYTES + _FIRST_BYTES, len(packet), 8))]
    last = len(parts) - 1
    return [
        Frame(fixed | (i & 7) << 2 | (i == 0) << 1 | (i == last), part, extended=True) for i, part in enumerate(parts)
    ]


@dataclass
class _Unfinished:
    packet: bytearray
    next_count: int
    deadline_ns: int


class CfpReceiver:
    """Puts CSP packets together, as libcsp does; `faults` counts what went wrong, by name.

    Parameters
    ----------
    address
        Take only packets for this CSP address and for the broadcast address 16383; None: take all.
    """

    def __init__(self, address: int | None = None) -> None:
        self._address = address
        self._open: dict[int, _Unfinished] = {}
        self.faults: Counter[str] = Counter()

    def push(self, frame: Frame, now_ns: int) -> bytes | None:
        """Take a frame; return the packet that it completes. Its CRC is yet to be checked: holes can hide."""
        if not frame.extended or frame.error or frame.fd:
            return None
        destination = frame.identifier >> 13 & 0x3FFF
        if self._address is not None and destination not in (self._address, 0x3FFF):
            return None
        key = frame.identifier & _CONNECTION
        take = self._begin if frame.identifier & 2 else self._continue
        found = take(key, frame, now_ns)
        if found is None:
            return None
        if frame.identifier & 1:
            return bytes(self._open.pop(key).packet)
        return None

    def _begin(self, key: int, frame: Frame, now_ns: int) -> _Unfinished | None:
        if self._open.pop(key, None) is not None:
            self.faults["cut short by another packet"] += 1
        if len(frame.data) < 4:
            self.faults["malformed"] += 1
            return None
        self._forget_old(now_ns)
        header = (frame.identifier >> 13 & 0xFFFF).to_bytes(2, "big")
        self._open[key] = _Unfinished(bytearray(header + frame.data), 1, now_ns + _TIMEOUT_NS)
        return self._open[key]

    def _continue(self, key: int, frame: Frame, now_ns: int) -> _Unfinished | None:
        unfinished = self._open.get(key)
        if unfinished is None:
            self.faults["without a beginning"] += 1
            return None
        if frame.identifier >> 2 & 7 != unfinished.next_count:
            del self._open[key]
            self.faults["out of order"] += 1
            return None
        if len(unfinished.packet) + len(frame.data) > _LONGEST_BYTES:
            del self._open[key]
            self.faults["too long"] += 1
            return None
        unfinished.packet += frame.data
        unfinished.next_count = (unfinished.next_count + 1) & 7
        unfinished.deadline_ns = now_ns + _TIMEOUT_NS
        return unfinished

    def _forget_old(self, now_ns: int) -> None:
        late = [key for key, unfinished in self._open.items() if now_ns > unfinished.deadline_ns]
        if len(self._open) - len(late) >= _MOST_CONNECTIONS:
            late.append(next(iter(self._open)))
        for key in late:
            del self._open[key]
            self.faults["timed out"] += 1
