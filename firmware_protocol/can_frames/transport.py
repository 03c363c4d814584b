"""Transport of messages in CAN frames: ISO-TP (ISO 15765-2) and CFP 2 (fragmentation of CSP version 2).

ISO-TP, normal addressing; the receiver controls the flow:

    single       0L data                L = 1..7; CAN FD, more than 8 bytes: 00 LL data, LL = 1..62
    first        1L LL data             12 bits of length, up to 4095; above: 10 00 and a big-endian u32
    consecutive  2n data                n counts 1..15, 0, 1 ... from the first frame on
    flow control 3s BS STmin            s: 0 continue, 1 wait, 2 overflow; BS frames until the next one, 0: all;
                                        STmin between frames: 00..7F ms, F1..F9 100..900 us, others as 7F

Frames are padded with 0xCC to eight bytes, and above eight to the next length that CAN FD has. Source: ISO 15765-2:2016
as implemented by the kernel's can-isotp (net/can/isotp.c) and by the Python package can-isotp, the reference of the
tests.

CFP 2 carries CSP packets in classic CAN frames with 29-bit identifiers.

Identifier:

    bit  28..27    26..13        12..7    6..5          4..2         1      0
         priority  destination   sender   packet count  frame count  begin  end

The data of the first frame start with the rest of the CSP header, big-endian, followed by up to four bytes of the
packet:

    bit  31..18   17..12             11..6         5..0
         source   destination port   source port   flags

All other frames carry eight bytes. Frame count is 0 in the first frame and counts modulo 8, packet count modulo 4: the
counts do not show a gap of exactly eight frames, only the CRC-32C at the end of a CSP packet does. Source: libcsp,
`csp_if_can.h` and `csp_if_can.c` (csp_can2_tx, csp_can2_rx), October 2024; compared with the output of csp_can2_tx,
compiled.

A packet has the same bytes here as on other transports: the six bytes of the CSP header, then the data, CRC included.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.can_frames.frame import Frame, fd_length

_PADDING = 0xCC
_SHORT_LENGTH = 0xFFF


class IsoTpFailure(Exception):
    """A message that could not be delivered; the text gives the peer's reaction."""


class FlowStatus(IntEnum):
    """Status in a flow-control frame of a receiver."""

    GO_ON = 0
    WAIT = 1
    OVERFLOW = 2


@dataclass(frozen=True)
class IsoTpSettings:
    """Settings of one channel.

    Attributes
    ----------
    send, receive : identifiers of this side's frames and of the peer's.
    fd : CAN FD frames of up to 64 bytes, with the faster bit rate for their data.
    flow_control
        True: wait for the peer's flow control. False: send at this side's own pace, for peers that only receive.
    block_size, separation : BS and STmin that this side requests of the peer.
    timeout_ns : N_Bs and N_Cr: longest wait for flow control, and for the next consecutive frame.
    waits : number of "wait" frames in a row that the peer may send.
    longest_bytes : longer messages are refused with an overflow.
    """

    send: int
    receive: int
    fd: bool = False
    flow_control: bool = True
    block_size: int = 0
    separation: int = 0
    timeout_ns: int = 1_000_000_000
    waits: int = 16
    longest_bytes: int = 65_536

    @property
    def frame_bytes(self) -> int:
        """Data bytes of the longest frame."""
        return 64 if self.fd else 8

    def frame(self, data: bytes) -> Frame:
        """Return a frame of this side, padded."""
        padded = data.ljust(max(8, fd_length(len(data))), bytes([_PADDING]))
        return Frame(self.send, padded, fd=self.fd, brs=self.fd)

    def is_ours(self, frame: Frame) -> bool:
        """Return true if the frame comes from the peer on this channel, whose identifiers have 11 bits."""
        return frame.identifier == self.receive and not (frame.extended or frame.error)


def separation_ns(code: int) -> int:
    """Return STmin in ns."""
    if 0xF1 <= code <= 0xF9:
        return (code - 0xF0) * 100_000
    return min(code, 0x7F) * 1_000_000


class IsoTpSender:
    """Sender of one message at a time: `start`, then `next_frame` until `busy` is over."""

    def __init__(self, settings: IsoTpSettings) -> None:
        self._settings = settings
        self._message = b""
        self._at = 0
        self._serial = 0
        self._begun = False
        self._waits = 0
        self._may_send: int | None = None  # frames until the next flow control; None: no limit
        self._separation_ns = 0
        self._next_ns = 0
        self._deadline_ns: int | None = None

    @property
    def busy(self) -> bool:
        """True while a message is being sent."""
        return bool(self._message)

    def start(self, message: bytes) -> None:
        """Begin with a message; the previous one must be complete."""
        if self.busy:
            raise ValueError("a message is still under way")
        if not 0 < len(message) < 1 << 32:
            raise ValueError(f"an ISO-TP message has 1 to 2^32 - 1 bytes, not {len(message)}")
        self._message = bytes(message)
        self._at = self._waits = 0
        self._begun = False
        self._deadline_ns = None

    def next_frame(self, now_ns: int) -> Frame | None:
        """Return the frame that may leave now, if there is one; raises IsoTpFailure if the peer is late."""
        if not self.busy:
            return None
        if not self._begun:
            return self._first(now_ns)
        if self._deadline_ns is not None and now_ns > self._deadline_ns:
            raise self._failed(f"the peer sent no flow control on {self._settings.receive:#x} in time")
        if self._deadline_ns is not None or now_ns < self._next_ns:
            return None
        return self._consecutive(now_ns)

    def flow_control(self, frame: Frame, now_ns: int) -> None:
        """Process a flow-control frame of the peer; raises IsoTpFailure if it refuses the message."""
        if self._deadline_ns is None or len(frame.data) < 3 or frame.data[0] >> 4 != 3:
            return
        status = frame.data[0] & 15
        block, code = frame.data[1], frame.data[2]
        if status == FlowStatus.WAIT:
            self._waits += 1
            if self._waits > self._settings.waits:
                raise self._failed("the peer sent too many wait frames")
            self._deadline_ns = now_ns + self._settings.timeout_ns
        elif status == FlowStatus.GO_ON:
            self._may_send = block or None
            self._separation_ns = separation_ns(code)
            self._deadline_ns = None
            self._waits = 0
            self._next_ns = now_ns
        else:
            raise self._failed("the peer has no room for it" if status == FlowStatus.OVERFLOW else "bad flow status")

    def abort(self) -> None:
        """Drop the message that is being sent."""
        self._message = b""
        self._deadline_ns = None

    def _failed(self, reason: str) -> IsoTpFailure:
        n = len(self._message)
        self.abort()
        return IsoTpFailure(f"a message of {n} bytes on {self._settings.send:#x} was given up: {reason}")

    def _first(self, now_ns: int) -> Frame:
        message, room = self._message, self._settings.frame_bytes
        if len(message) <= 7:
            self.abort()
            return self._settings.frame(bytes([len(message)]) + message)
        if len(message) <= room - 2 and room > 8:
            self.abort()
            return self._settings.frame(bytes([0, len(message)]) + message)
        self._begun, self._serial = True, 0
        if len(message) <= _SHORT_LENGTH:
            head = (0x1000 | len(message)).to_bytes(2, "big")
        else:
            head = b"\x10\x00" + len(message).to_bytes(4, "big")
        self._at = room - len(head)
        if self._settings.flow_control:
            self._deadline_ns = now_ns + self._settings.timeout_ns
        else:
            self._may_send, self._separation_ns = None, separation_ns(self._settings.separation)
            self._next_ns = now_ns + self._separation_ns
        return self._settings.frame(head + message[: self._at])

    def _consecutive(self, now_ns: int) -> Frame:
        self._serial = (self._serial + 1) & 15
        part = self._message[self._at : self._at + self._settings.frame_bytes - 1]
        self._at += len(part)
        self._next_ns = now_ns + self._separation_ns
        if self._may_send is not None:
            self._may_send -= 1
        if self._at >= len(self._message):
            self.abort()
        elif self._may_send == 0:
            self._deadline_ns = now_ns + self._settings.timeout_ns
        return self._settings.frame(bytes([0x20 | self._serial]) + part)


class IsoTpReceiver:
    """Assembler of messages. `faults` counts errors by name, so that reports can print them."""

    def __init__(self, settings: IsoTpSettings) -> None:
        self._settings = settings
        self._message = bytearray()
        self._length = 0
        self._serial = 0
        self._in_block = 0
        self._deadline_ns = 0
        self.faults: Counter[str] = Counter()
        self.reply: Frame | None = None

    def push(self, frame: Frame, now_ns: int) -> bytes | None:
        """Process a frame; return the message that it completes. `reply` is then the flow control to send, or None."""
        self.reply = None
        if not self._settings.is_ours(frame) or not frame.data:
            return None
        if self._length and now_ns > self._deadline_ns:
            self._give_up("timed out")
        kind = frame.data[0] >> 4
        if kind == 0:
            return self._single(frame.data)
        if kind == 1:
            self._begin(frame.data, now_ns)
        elif kind == 2:
            return self._continue(frame.data, now_ns)
        return None

    def _give_up(self, reason: str) -> None:
        self.faults[reason] += 1
        self._length = 0
        self._message.clear()

    def _single(self, data: bytes) -> bytes | None:
        if self._length:
            self._give_up("cut short by another message")
        length, at = data[0] & 15, 1
        if length == 0 and len(data) > 8:
            length, at = data[1], 2
        if not 0 < length <= len(data) - at:
            self.faults["malformed"] += 1
            return None
        return data[at : at + length]

    def _begin(self, data: bytes, now_ns: int) -> None:
        if self._length:
            self._give_up("cut short by another message")
        length, at = int.from_bytes(data[:2], "big") & _SHORT_LENGTH, 2
        if length == 0 and len(data) >= 6:
            length, at = int.from_bytes(data[2:6], "big"), 6
        if length <= len(data) - at or len(data) < 8:
            self.faults["malformed"] += 1
        elif length > self._settings.longest_bytes:
            self.faults["too long"] += 1
            self._answer(FlowStatus.OVERFLOW)
        else:
            self._length = length
            self._serial = self._in_block = 0
            self._message[:] = data[at:]
            self._deadline_ns = now_ns + self._settings.timeout_ns
            self._answer(FlowStatus.GO_ON)

    def _continue(self, data: bytes, now_ns: int) -> bytes | None:
        if not self._length:
            self.faults["without a beginning"] += 1
            return None
        if data[0] & 15 != (self._serial + 1) & 15:
            self._give_up("out of order")
            return None
        self._serial = (self._serial + 1) & 15
        self._message += data[1:]
        self._deadline_ns = now_ns + self._settings.timeout_ns
        if len(self._message) >= self._length:
            message = bytes(self._message[: self._length])
            self._length = 0
            return message
        self._in_block += 1
        if self._in_block == self._settings.block_size:
            self._in_block = 0
            self._answer(FlowStatus.GO_ON)
        return None

    def _answer(self, status: FlowStatus) -> None:
        if self._settings.flow_control:
            s = self._settings
            self.reply = s.frame(bytes([0x30 | status, s.block_size, s.separation]))


CFP_HEADER_BYTES = 6
"""Bytes of the CSP version 2 header."""

_FIRST_BYTES = 4
_CONNECTION = 0x1FFF_FFFF & ~0x1F  # priority, destination, sender and packet count: one open packet for each
_TIMEOUT_NS = 1_000_000_000  # PBUF_TIMEOUT_MS in csp_if_can_pbuf.c
_LONGEST_BYTES = 4096
_MOST_CONNECTIONS = 64


def cfp_frames(packet: bytes, sender: int, packet_count: int) -> list[Frame]:
    """Return the frames of a CSP packet, header first, from address `sender`, six bits; ValueError without a header."""
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
    """Assembler of CSP packets, as in libcsp; `faults` counts errors by name.

    `address`: CSP address whose packets are accepted, with those for the broadcast address 16383; None: all packets.
    """

    def __init__(self, address: int | None = None) -> None:
        self._address = address
        self._open: dict[int, _Unfinished] = {}
        self.faults: Counter[str] = Counter()

    def push(self, frame: Frame, now_ns: int) -> bytes | None:
        """Process a frame; return the packet that it completes. Check its CRC: gaps may be undetected."""
        if not frame.extended or frame.error or frame.fd:
            return None
        destination = frame.identifier >> 13 & 0x3FFF
        if self._address is not None and destination not in (self._address, 0x3FFF):
            return None
        key = frame.identifier & _CONNECTION
        take = self._begin if frame.identifier & 2 else self._continue
        unfinished = take(key, frame, now_ns)
        if unfinished is None:
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
