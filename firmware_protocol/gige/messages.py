"""The message channel: what a camera tells its host unasked.

    message   a GVCP request of the camera, EVENT: u16 0 | u16 event | u16 stream, 0xFFFF none | u16 block | u64 ns
              or EVENTDATA: the same, then the data; of an edge u32 its kind, as in `edges`
    answer    u16 status | u16 EVENT + 1, or EVENTDATA + 1 | u16 0 | u16 id

Where the host has set a timeout, a message asks for an answer and is repeated until it comes, as often as the host has
said; the next one waits meanwhile. Otherwise each is sent once.

Source: GigE Vision 2.0 as implemented in the open by Wireshark's dissector; what viva-genicam answers.
"""

from __future__ import annotations

import struct
from collections import Counter, deque
from dataclasses import dataclass

from firmware_protocol.gige.gvcp import Command, request

__all__ = ["EDGE_EVENT", "MessageSettings", "Messages"]

EDGE_EVENT = 0x9000
"""The event of an edge on the trigger input; ids from 0x9000 on are the device's own."""

_NO_STREAM = 0xFFFF
_MOST = 256
_PAYLOAD = struct.Struct(">HHHHQ")
_ANSWER = struct.Struct(">HHHH")


@dataclass(frozen=True)
class MessageSettings:
    """How long an answer may take, 0: none is asked for; and how often a message is repeated without one."""

    timeout_ns: int = 0
    retries: int = 0


@dataclass
class _Sent:
    number: int
    command: Command
    payload: bytes
    again_ns: int
    left: int


class Messages:
    """Messages on their way to a host.

    Attributes
    ----------
    counts
        Messages by what became of them.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Command, bytes]] = deque()
        self._sent: _Sent | None = None
        self._number = 0
        self.counts: Counter[str] = Counter()

    def tell(self, event: int, time_ns: int, data: bytes = b"") -> None:
        """Queue a message, an EVENTDATA where there are data; one that finds no room is counted as lost."""
        if len(self._waiting) == _MOST:
            self.counts["messages lost"] += 1
            return
        payload = _PAYLOAD.pack(0, event, _NO_STREAM, 0, time_ns) + data
        self._waiting.append((Command.EVENTDATA if data else Command.EVENT, payload))

    def next(self, now_ns: int, settings: MessageSettings) -> bytes | None:
        """Return the next message to send, or one to send again; None while an answer may still come."""
        if self._sent is not None and now_ns < self._sent.again_ns:
            return None
        if self._sent is not None and self._sent.left == 0:
            self._sent = None
            self.counts["messages lost"] += 1
        if self._sent is None:
            if not self._waiting:
                return None
            self._number = self._number % 0xFFFF + 1
            self._sent = _Sent(self._number, *self._waiting.popleft(), 0, settings.retries + 1)
            self.counts["messages"] += 1
        sent = self._sent
        sent.again_ns, sent.left = now_ns + settings.timeout_ns, sent.left - 1
        if not settings.timeout_ns:
            self._sent = None
        return request(sent.command, sent.number, sent.payload, flags=int(settings.timeout_ns > 0))

    def answered(self, datagram: bytes) -> None:
        """Take what came from the host: the answer to the message that was sent last, or nothing of meaning."""
        if self._sent is None or len(datagram) != _ANSWER.size:
            return
        _, command, _, number = _ANSWER.unpack(datagram)
        if (command, number) == (self._sent.command + 1, self._sent.number):
            self._sent = None

    def clear(self) -> None:
        """Forget what waits; what was not sent is counted as lost."""
        self.counts["messages lost"] += len(self._waiting)
        self._waiting.clear()
        self._sent = None
