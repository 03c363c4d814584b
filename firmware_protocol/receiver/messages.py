"""What a receiver does with an instrument's messages: events and edges to the inbox, answers to reports."""

from __future__ import annotations

from collections import Counter

from firmware_protocol.events import empty_events
from firmware_protocol.packets.errors import PacketError
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.message import Message, MessageKind
from firmware_protocol.packets.verification import RequestId, Verification
from firmware_protocol.receiver.inbox import Inbox
from firmware_protocol.telemetry import BlockEncoder, BlockError, BlockSettings, decode_block

__all__ = ["MessageReader"]

_MOST_REQUESTS = 1024


class MessageReader:
    """Reads messages, whichever packets carried them.

    Attributes
    ----------
    counts
        Messages by kind, `events_dropped` and `edges_dropped` as the blocks tell them, `bad_blocks`, `bad_answers`.
    housekeeping
        The newest report; None before the first.
    """

    def __init__(self, inbox: Inbox) -> None:
        self._inbox = inbox
        self._requests: dict[RequestId, str] = {}
        self.counts: Counter[str] = Counter()
        self.housekeeping: Housekeeping | None = None
        _load_kernels()

    def expect(self, request: RequestId, name: str) -> None:
        """Name the telecommand that verifications of `request` belong to; the last 1024 are known."""
        if len(self._requests) == _MOST_REQUESTS:
            del self._requests[next(iter(self._requests))]
        self._requests[request] = name

    def read(self, message: Message) -> None:
        """Take a message; one with a bad payload is counted."""
        self.counts[message.kind.value] += 1
        if message.kind in (MessageKind.EVENTS, MessageKind.EDGES):
            self._block(message)
        else:
            self._answer(message)

    @property
    def bad(self) -> int:
        """Messages in sound packets whose payload was wrong."""
        return self.counts["bad_blocks"] + self.counts["bad_answers"]

    def _block(self, message: Message) -> None:
        try:
            block = decode_block(message.payload, message.t_us)
        except BlockError:
            self.counts["bad_blocks"] += 1
            return
        self.counts["events_dropped" if message.kind is MessageKind.EVENTS else "edges_dropped"] += block.dropped
        self._inbox.put_events(block.events)
        self._inbox.put_edges(block.edges)

    def _answer(self, message: Message) -> None:
        try:
            if message.kind is MessageKind.HOUSEKEEPING:
                self.housekeeping = Housekeeping.parse(message.payload)
            elif message.kind is MessageKind.VERIFICATION:
                self._inbox.put_report(self._verified(Verification.parse(message.payload)))
            else:
                self._inbox.put_report(message.kind.value)
        except PacketError:
            self.counts["bad_answers"] += 1

    def _verified(self, verification: Verification) -> str:
        command = self._requests.get(verification.request, "a telecommand of somebody else")
        stage = verification.stage.name.lower()
        if verification.failure is None:
            return f"{command}: {stage} good"
        return f"{command}: {stage} failed: {verification.failure.text} (code {verification.failure.code.value})"


def _load_kernels() -> None:
    """Load the decoder's compiled code before a line waits for it: it takes a good part of a second."""
    for mode in ("rows", "bitmap", "flat"):
        block, _ = BlockEncoder((2, 2), BlockSettings(mode=mode)).encode(empty_events(2))
        decode_block(block)
