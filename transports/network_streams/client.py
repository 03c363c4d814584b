"""One client of a TCP stream: what waits for it, within a bound, and what it has missed."""

from __future__ import annotations

import asyncio
import socket
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

from transports.link.pacing import Clock
from transports.network_streams.fates import Batch, Fates

__all__ = ["Client", "ClientTerms"]

_MOST_HEARD = 1 << 16  # bytes that a client may say: these protocols have no requests
_STALLED_NS = 2_000_000_000


@dataclass(frozen=True)
class ClientTerms:
    """What all clients of a stream have in common.

    Attributes
    ----------
    greeting
        What each gets first.
    most_bytes
        What waits for one at most; one batch more may be on its way.
    """

    greeting: bytes
    most_bytes: int


class Client(asyncio.Protocol):
    """A connection that only takes.

    Attributes
    ----------
    missed
        Events that it had no room for.
    talked
        Whether it was closed because it said too much.
    """

    def __init__(
        self, terms: ClientTerms, fates: Fates, clock: Clock, joined: Callable[[Client], None],
        left: Callable[[Client], None],
    ) -> None:  # fmt: skip
        self._terms = terms
        self._fates = fates
        self._clock = clock
        self._joined = joined
        self._left = left
        self._transport: asyncio.Transport | None = None
        self._queue: deque[Batch] = deque()
        self._sending: Batch | None = None
        self._paused = False
        self._waiting_bytes = self._heard = 0
        self._progress_ns = clock.now_ns()
        self.missed = 0
        self.talked = False

    @property
    def has_room(self) -> bool:
        """Whether it can be given a batch now."""
        return self._waiting_bytes < self._terms.most_bytes

    @property
    def stalled(self) -> bool:
        """Whether something waits for it, and it has taken nothing for two seconds."""
        return self._waiting_bytes > 0 and self._clock.now_ns() - self._progress_ns > _STALLED_NS

    def holds(self, batch: Batch) -> bool:
        """Say whether a batch waits for it, first of all."""
        return batch is self._sending or (bool(self._queue) and batch is self._queue[0])

    def offer(self, batch: Batch) -> None:
        """Give it a batch, of which it is a holder; it is sent by `send_on`."""
        if not self._waiting_bytes:
            self._progress_ns = self._clock.now_ns()
        self._queue.append(batch)
        self._waiting_bytes += len(batch.data)

    def send_on(self) -> None:
        """Send as much as its socket takes."""
        while self._queue and not self._paused and self._transport is not None and not self._transport.is_closing():
            self._sending = self._queue.popleft()
            self._transport.write(self._sending.data)
            if not self._paused and not self._transport.is_closing():
                self._written()

    def hang_up(self) -> None:
        """Close when what is on its way has gone; what waits behind it is not sent."""
        if self._transport is not None:
            self._transport.close()

    def abort(self) -> None:
        """Close at once."""
        if self._transport is not None:
            self._transport.abort()

    # What asyncio calls.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Greet."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        transport.set_write_buffer_limits(high=0)  # so that "not paused" means that the socket has taken everything
        _keep_alive(transport.get_extra_info("socket"))
        transport.write(self._terms.greeting)
        self._joined(self)

    def data_received(self, data: bytes) -> None:
        """Ignore what it says, up to a bound."""
        self._heard += len(data)
        if self._heard > _MOST_HEARD:
            self.talked = True
            self.abort()

    def pause_writing(self) -> None:
        """The socket is full."""
        self._paused = True

    def resume_writing(self) -> None:
        """The socket has taken what was on its way."""
        self._paused = False
        if self._sending is not None:
            self._written()
        self.send_on()

    def connection_lost(self, error: Exception | None) -> None:
        """Give up what waits."""
        waiting = [*([self._sending] if self._sending is not None else []), *self._queue]
        self._queue.clear()
        self._sending = None
        self._transport = None
        for batch in waiting:
            self._fates.dropped(batch)
        self._left(self)

    def _written(self) -> None:
        batch, self._sending = self._sending, None
        assert batch is not None
        self._waiting_bytes -= len(batch.data)
        self._progress_ns = self._clock.now_ns()
        self._fates.written(batch)


def _keep_alive(sock: socket.socket) -> None:
    """Let the kernel find out when the client's machine has gone without a word."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for option, value in (("TCP_KEEPIDLE", 30), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 3)):
        if hasattr(socket, option):
            sock.setsockopt(socket.IPPROTO_TCP, getattr(socket, option), value)
