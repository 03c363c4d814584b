"""A CAN bus that evstim makes itself and lends to others over TCP, in the protocol of socketcand.

The wire is modelled: bit rate, stuff bits, arbitration, one frame at a time (`firmware_protocol.can_frames.wire`).
Others join with python-can (`interface = "socketcand"`), with `evstim listen can`, or through socketcand's own client
onto a vcan of another machine. What it does not model: errors, acknowledgement, CAN FD. A client that reads too slowly
misses frames, which are counted.

Several nodes of the wire are ours: one for ordinary frames, and one for each urgent identifier, as a controller with
that many transmit buffers has; so a SYNC waits for one frame at most, also when a heartbeat cannot get through.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from contextlib import suppress
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import GREETING, SocketcandSession, frame_line
from firmware_protocol.can_frames.wire import Carried, Wire
from transports.can_bus.bus import BusDown, CanBus, Heard
from transports.can_bus.parameters import CanParameters
from transports.link.pacing import Clock

__all__ = ["ServedBus"]

_ORDINARY, _STRANGER = 0, 1
_MOST_WAITING = 48  # frames handed over and not begun: 5 ms of a full bus, so that ticks may be late
_MOST_UNSENT_BYTES = 1 << 20
_SETTLE_NS = 250_000_000  # python-can takes an answer of the handshake for garbage when a frame follows too soon
_READ_BYTES = 65_536


@dataclass
class _Client:
    node: int
    session: SocketcandSession
    writer: asyncio.StreamWriter
    listens_ns: int | None = None

    def listens(self, t_ns: int) -> bool:
        """Say whether it is to be told of a frame at `t_ns`."""
        return self.listens_ns is not None and t_ns >= self.listens_ns and not self.writer.is_closing()


class ServedBus(CanBus):
    """The bus, and everybody on it."""

    def __init__(self, parameters: CanParameters, clock: Clock) -> None:
        self._parameters = parameters
        self._clock = clock
        self._wire = Wire(parameters.rates)
        self._server: asyncio.Server | None = None
        self._clients: dict[int, _Client] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._nodes = itertools.count(2)
        self._unread: list[Heard] = []
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns()
        self.missed = 0

    @property
    def address(self) -> str:
        """Host and port."""
        if self._server is None or not self._server.sockets:
            return f"{self._parameters.host}:{self._parameters.port}"
        host, port = self._server.sockets[0].getsockname()[:2]
        return f"{host}:{port}"

    @property
    def waiting(self) -> int:
        """Our ordinary frames that have not begun."""
        return self._wire.waiting(_ORDINARY)

    @property
    def heard(self) -> bool:
        """True while anybody listens: a frame that nobody hears is not acknowledged, and so never sent."""
        now_ns = self._clock.now_ns()
        return any(client.listens(now_ns) for client in self._clients.values())

    async def open(self) -> None:
        """Listen; raises BusDown when the port cannot be had."""
        p = self._parameters
        try:
            self._server = await asyncio.start_server(self._serve, p.host, p.port)
        except OSError as error:
            raise BusDown(
                error.errno,
                f"cannot serve a CAN bus on {p.host} port {p.port}: {error.strerror}; another evstim or socketcand may "
                "hold it: stop that one, or give this link another port (0 takes a free one)",
            ) from error

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """See `CanBus.send`."""
        node = _mailbox(frame) if urgent else _ORDINARY
        if self._wire.waiting(node) >= _MOST_WAITING:
            return False
        now_ns = self._clock.now_ns()
        self._carry(now_ns)
        self._wire.offer(node, frame, now_ns)
        return True

    def flood(self, frame: Frame, t_ns: int) -> None:
        """See `CanBus.flood`."""
        self._wire.offer(_STRANGER, frame, t_ns)

    def take(self) -> list[Heard]:
        """See `CanBus.take`."""
        self._carry(self._clock.now_ns())
        heard, self._unread = self._unread, []
        return heard

    async def close(self) -> None:
        """Send off everybody."""
        if self._server is not None:
            self._server.close()
        writers = [client.writer for client in self._clients.values()]
        for task in list(self._tasks):
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        await asyncio.gather(*(writer.wait_closed() for writer in writers), return_exceptions=True)

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        task = asyncio.current_task()
        assert task is not None
        self._tasks.add(task)
        client = _Client(next(self._nodes), SocketcandSession(self._parameters.channel), writer)
        self._clients[client.node] = client
        try:
            with suppress(ConnectionError, asyncio.CancelledError):
                writer.write(GREETING)
                await self._talk(client, reader)
        finally:
            del self._clients[client.node]
            self._wire.forget(client.node)
            self._tasks.discard(task)
            writer.close()

    async def _talk(self, client: _Client, reader: asyncio.StreamReader) -> None:
        while not client.session.refused and (data := await reader.read(_READ_BYTES)):
            now_ns = self._clock.now_ns()
            self._carry(now_ns)
            answer, frames = client.session.push(data)
            if answer:
                client.writer.write(answer)
            if client.session.raw and client.listens_ns is None:
                client.listens_ns = now_ns + _SETTLE_NS
            for frame in frames:
                self._wire.offer(client.node, frame, now_ns)
            self._carry(now_ns)

    def _carry(self, now_ns: int) -> None:
        """Let the wire move on, and tell everybody what it carried."""
        for carried in self._wire.advance(now_ns):
            if carried.node != _ORDINARY:
                self._unread.append(Heard(carried.frame, carried.end_ns, own=carried.node < _ORDINARY))
            if self._clients:
                self._tell(carried)

    def _tell(self, carried: Carried) -> None:
        line = frame_line(carried.frame, (carried.end_ns + self._wall_offset_ns) // 1000)
        for client in self._clients.values():
            if client.node == carried.node or not client.listens(carried.end_ns):
                continue
            if client.writer.transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
                self.missed += 1
            else:
                client.writer.write(line)


def _mailbox(frame: Frame) -> int:
    """Return the node of the wire that stands for the transmit buffer of an urgent frame."""
    return -1 - frame.identifier
