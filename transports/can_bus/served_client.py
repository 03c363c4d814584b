"""The bus's end of one client's connection, in the protocol of socketcand.

What the client can fill is bounded: one read, the frames that wait for the bus (then nothing more is read until there
is room), and what it has not read. A client with too much unread misses frames; one that also asks for answers is sent
off.
"""

from __future__ import annotations

import asyncio
from collections import deque
from typing import Protocol

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import GREETING, SocketcandSession

__all__ = ["BusClient", "ClientHost"]

_READ_BYTES = 4096
_MOST_UNSENT_BYTES = 1 << 20
_MOST_FRAMES = 48  # of a client that wait for the bus before no more are read


class ClientHost(Protocol):
    """What a client asks of its bus."""

    def offer(self, client: BusClient, frames: list[Frame]) -> int:
        """Take frames that a client sends; return how many of its frames wait."""

    def joined(self, client: BusClient) -> None:
        """Hear that a client uses the bus."""

    def deaf(self, client: BusClient) -> None:
        """Hear that a client asks and does not read, and is sent off."""

    def left(self, client: BusClient) -> None:
        """Hear that a connection is over."""


class BusClient(asyncio.BufferedProtocol):
    """One client; `node` is its number on the wire.

    Attributes
    ----------
    wants_frames
        True when it wants to be told of every frame.
    """

    _transport: asyncio.Transport

    def __init__(self, node: int, channel: str, host: ClientHost) -> None:
        self.node = node
        self._host = host
        self._session = SocketcandSession(channel)
        self._room = bytearray(_READ_BYTES)
        self._told: deque[int] = deque()  # where each line that is not sent ends, in all bytes written
        self._written = 0
        self._paused = self._leaving = False

    @property
    def wants_frames(self) -> bool:
        """See the class."""
        return self._session.raw and not self._leaving and not self._transport.is_closing()

    @property
    def unsent_lines(self) -> int:
        """Frames that it was told of and that are still with us."""
        sent = self._written - self._transport.get_write_buffer_size()
        while self._told and self._told[0] <= sent:
            self._told.popleft()
        return len(self._told)

    def tell(self, line: bytes) -> bool:
        """Tell it of a frame; False when it has too much unread."""
        if self._transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
            return False
        self._write(line)
        if self._transport.get_write_buffer_size():
            self._told.append(self._written)
        else:
            self._told.clear()
        return True

    def resume(self, waiting: int) -> None:
        """Read on when there is room for its frames again."""
        if self._paused and waiting < _MOST_FRAMES:
            self._paused = False
            self._transport.resume_reading()

    def close(self) -> None:
        """Send it off when it has read everything: it sees the end, and closes.

        Until then what it sends is read and dropped. Closing a socket with something unread would reset the connection,
        and frames that it was told of would never arrive.
        """
        self._leaving = True
        if self._transport.is_closing():
            return
        self._transport.resume_reading()
        try:
            self._transport.write_eof()
        except OSError:  # the client was faster, and asyncio has not noticed yet
            self._transport.abort()

    def abort(self) -> None:
        """Send it off at once."""
        self._transport.abort()

    # The asyncio side.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Take a connected socket."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._write(GREETING)

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return where the next bytes go."""
        return self._room

    def buffer_updated(self, nbytes: int) -> None:
        """Take bytes from the client."""
        if self._leaving:
            return
        answer, frames = self._session.push(bytes(memoryview(self._room)[:nbytes]))
        if self._session.raw or frames:
            self._host.joined(self)
        if answer and self._transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
            self._host.deaf(self)
            self._transport.abort()
            return
        self._write(answer)
        if self._session.refused:
            self._transport.close()
        elif self._host.offer(self, frames) >= _MOST_FRAMES and not self._paused:
            self._paused = True
            self._transport.pause_reading()

    def connection_lost(self, error: Exception | None) -> None:
        """Hear that the connection is over."""
        self._host.left(self)

    def _write(self, data: bytes) -> None:
        self._written += len(data)
        self._transport.write(data)
