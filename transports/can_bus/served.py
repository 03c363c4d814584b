"""A CAN bus that evstim makes itself and lends to others over TCP, in the protocol of socketcand.

The wire is modelled: bit rate, stuff bits, arbitration, one frame at a time (see `socketcand` of the CAN frames).
Others join with python-can (`interface = "socketcand"`), with `evstim listen can`, or through socketcand's own client
onto a vcan of another machine. What it does not model: errors, acknowledgement, CAN FD. A client that reads too slowly
misses frames, which are counted.

Several nodes of the wire are ours: one for ordinary frames, and one for each urgent identifier, as a controller with
that many transmit buffers has; so a SYNC waits for one frame at most, also when a heartbeat cannot get through.

The bus's end of one client's connection, in the protocol of socketcand.

What the client can fill is bounded: one read, the frames that wait for the bus (then nothing more is read until there
is room), and what it has not read. A client with too much unread misses frames; one that also asks for answers is sent
off.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Protocol

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import GREETING, Carried, SocketcandSession, Wire, frame_line
from transports.can_bus.bus import BusDown, CanBus, Heard
from transports.can_bus.kind import CanLink
from transports.link.pacing import Clock
from transports.network.datagrams import Admission, AllowList, Places, Seat
from transports.network.listener import Listener

__all__ = ["BusClient", "ClientHost", "ServedBus"]


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


_ORDINARY, _STRANGER = 0, 1
_MOST_WAITING = 48  # frames handed over and not begun: 5 ms of a full bus, so that ticks may be late
_MOST_UNREAD = 100_000  # frames of others that the endpoint has not taken: none while its bus is off by a fault
_SETTLE_NS = 250_000_000  # python-can takes an answer of the handshake for garbage when a frame follows too soon
_PLACES = Places(total=32, per_address=16)
_REFUSAL = b"< error too many clients >"
_CLOSE_TURNS, _CLOSE_TURN_S = 1000, 0.001  # clients have a second to read the rest


@dataclass(frozen=True)
class _Member:
    """A connection, and since when it wants frames (None: it does not)."""

    client: BusClient
    seat: Seat
    listens_ns: int | None = None

    def listens(self, t_ns: int) -> bool:
        """Say whether it is to be told of a frame at `t_ns`."""
        return self.listens_ns is not None and t_ns >= self.listens_ns and self.client.wants_frames


class ServedBus(CanBus):
    """The bus, and everybody on it."""

    def __init__(self, parameters: CanLink, clock: Clock) -> None:
        self._parameters = parameters
        self._clock = clock
        self._wire = Wire(parameters.rates)
        self._admission = Admission(AllowList(parameters.allow), _PLACES)
        self._listener = Listener(self._admission, self._welcome, _REFUSAL)
        self._members: dict[int, _Member] = {}
        self._nodes = itertools.count(2)
        self._unread: deque[Heard] = deque(maxlen=_MOST_UNREAD)
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns()
        self._counts: Counter[str] = Counter()
        self.missed = 0

    @property
    def address(self) -> str:
        """Host and port."""
        host, port = self._listener.address or (self._parameters.host, self._parameters.port)
        return f"{host}:{port}"

    @property
    def waiting(self) -> int:
        """Our ordinary frames that have not begun."""
        return self._wire.waiting(_ORDINARY)

    @property
    def heard(self) -> bool:
        """True while anybody listens: a frame that nobody hears is not acknowledged, and so never sent."""
        now_ns = self._clock.now_ns()
        return any(member.listens(now_ns) for member in self._members.values())

    @property
    def counts(self) -> Mapping[str, int]:
        """Clients that were refused or sent off."""
        return self._counts + self._admission.counts

    async def open(self) -> None:
        """Listen; raises BusDown when the port cannot be had."""
        p = self._parameters
        try:
            self._listener.open(p.host, p.port)
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
        heard = list(self._unread)
        self._unread.clear()
        return heard

    def discard(self) -> None:
        """See `CanBus.discard`; a frame that has begun is not interrupted."""
        self._wire.forget(_ORDINARY)

    async def close(self) -> None:
        """Let the frame on the wire end, and send off everybody when they have read everything, or a second later."""
        await self._listener.close()
        await self._until(lambda: not self._wire.busy)
        for member in self._members.values():
            member.client.close()
        await self._until(lambda: not self._members)
        for member in self._members.values():
            self.missed += member.client.unsent_lines
            member.client.abort()
        await self._until(lambda: not self._members)

    # What clients ask (`transports.can_bus.served.ClientHost`).

    def joined(self, client: BusClient) -> None:
        """Keep a client from now on, and tell it of frames if it wants that."""
        member = self._members[client.node]
        self._admission.settle(member.seat)
        if client.wants_frames and member.listens_ns is None:
            self._members[client.node] = _Member(client, member.seat, self._clock.now_ns() + _SETTLE_NS)

    def offer(self, client: BusClient, frames: list[Frame]) -> int:
        """Put a client's frames on the wire."""
        now_ns = self._clock.now_ns()
        self._carry(now_ns)
        for frame in frames:
            self._wire.offer(client.node, frame, now_ns)
        self._carry(now_ns)
        return self._wire.waiting(client.node)

    def deaf(self, client: BusClient) -> None:
        """Count a client that does not read."""
        self._counts["clients sent off that did not read"] += 1

    def left(self, client: BusClient) -> None:
        """Forget a client, and what it had not begun to send."""
        self._admission.leave(self._members.pop(client.node).seat)
        self._wire.forget(client.node)

    def _welcome(self, seat: Seat) -> BusClient:
        client = BusClient(next(self._nodes), self._parameters.channel, self)
        self._members[client.node] = _Member(client, seat)
        return client

    async def _until(self, over: Callable[[], bool]) -> None:
        for _ in range(_CLOSE_TURNS):
            if over():
                return
            await asyncio.sleep(_CLOSE_TURN_S)
            self._carry(self._clock.now_ns())

    def _carry(self, now_ns: int) -> None:
        """Let the wire move on, and tell everybody what it carried."""
        for carried in self._wire.advance(now_ns):
            if carried.node != _ORDINARY:
                self._unread.append(Heard(carried.frame, carried.end_ns, own=carried.node < _ORDINARY))
            if carried.node in self._members:
                self._members[carried.node].client.resume(self._wire.waiting(carried.node))
            if self._members:
                self._tell(carried)

    def _tell(self, carried: Carried) -> None:
        line = frame_line(carried.frame, (carried.end_ns + self._wall_offset_ns) // 1000)
        for member in self._members.values():
            if member.client.node != carried.node and member.listens(carried.end_ns):
                self.missed += not member.client.tell(line)


def _mailbox(frame: Frame) -> int:
    """Return the node of the wire that stands for the transmit buffer of an urgent frame."""
    return -1 - frame.identifier
