"""CAN bus that evstim provides to other programs over TCP, in the protocol of socketcand.

The wire is modelled: bit rate, stuff bits, arbitration, one frame at a time (see `socketcand` of the CAN frames).
Clients join with python-can (`interface = "socketcand"`), with `evstim listen can`, or through socketcand's own client
onto a vcan of another machine. Errors, acknowledgement and CAN FD are not modelled.

Several nodes of the wire are ours: one for ordinary frames, and one for each urgent identifier, as in a controller with
that many transmit buffers. So a SYNC waits for one frame at most, even if a heartbeat is blocked.

The memory that a client can fill is bounded: one read, the frames that wait for the bus (no more are read until there
is room), and its unread data. A client with too much unread data misses frames, which are counted; one that also
requests answers is disconnected.
"""

from __future__ import annotations

import asyncio
import itertools
import time
from collections import Counter, deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import GREETING, SocketcandSession, Wire, frame_line
from transports.can_bus.bus import BusDown, CanBus, TimedFrame
from transports.can_bus.kind import CanLink
from transports.connections import Admission, Listener, Places, Seat
from transports.link.pacing import Clock
from transports.network import AllowList

_READ_BYTES = 4096
_MOST_UNSENT_BYTES = 1 << 20
_MOST_FRAMES = 48  # of one client that may wait for the bus before its reading pauses


class BusClient(asyncio.BufferedProtocol):
    """One client's connection in the protocol of socketcand, `node` on the wire; `wants_frames`: it requested all."""

    _transport: asyncio.Transport

    def __init__(self, node: int, channel: str, host: ServedBus) -> None:
        self.node = node
        self._host = host
        self._session = SocketcandSession(channel)
        self._room = bytearray(_READ_BYTES)
        self._line_ends: deque[int] = deque()  # end of each line not yet sent, counted in all bytes written
        self._written = 0
        self._paused = self._leaving = False

    @property
    def wants_frames(self) -> bool:
        """See the class."""
        return self._session.raw and not self._leaving and not self._transport.is_closing()

    @property
    def unsent_lines(self) -> int:
        """Number of frames written for the client that are still in our buffer."""
        sent = self._written - self._transport.get_write_buffer_size()
        while self._line_ends and self._line_ends[0] <= sent:
            self._line_ends.popleft()
        return len(self._line_ends)

    def send_line(self, line: bytes) -> bool:
        """Send a frame to the client; return False when it has too much unread data."""
        if self._transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
            return False
        self._write(line)
        if self._transport.get_write_buffer_size():
            self._line_ends.append(self._written)
        else:
            self._line_ends.clear()
        return True

    def resume(self, waiting: int) -> None:
        """Continue reading when there is room for the client's frames again."""
        if self._paused and waiting < _MOST_FRAMES:
            self._paused = False
            self._transport.resume_reading()

    def close(self) -> None:
        """Close the connection when the client has read everything: it sees the end, and closes its side.

        Until then the client's data are read and dropped. Closing a socket with unread data would reset the connection,
        and frames already sent to the client would never arrive.
        """
        self._leaving = True
        if self._transport.is_closing():
            return
        self._transport.resume_reading()
        try:
            self._transport.write_eof()
        except OSError:  # the client closed first, and asyncio has not noticed yet
            self._transport.abort()

    def abort(self) -> None:
        """Close the connection at once."""
        self._transport.abort()

    # Callbacks of asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport of a connected socket."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        self._write(GREETING)

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return the buffer for the next bytes."""
        return self._room

    def buffer_updated(self, nbytes: int) -> None:
        """Process bytes from the client."""
        if self._leaving:
            return
        answer, frames = self._session.push(bytes(memoryview(self._room)[:nbytes]))
        if self._session.raw or frames:
            self._host.joined(self)
        if answer and self._transport.get_write_buffer_size() > _MOST_UNSENT_BYTES:
            self._host.slow(self)
            self._transport.abort()
            return
        self._write(answer)
        if self._session.refused:
            self._transport.close()
        elif self._host.offer(self, frames) >= _MOST_FRAMES and not self._paused:
            self._paused = True
            self._transport.pause_reading()

    def connection_lost(self, error: Exception | None) -> None:
        """Inform the bus that the connection has ended."""
        self._host.left(self)

    def _write(self, data: bytes) -> None:
        self._written += len(data)
        self._transport.write(data)


_ORDINARY, _STRANGER = 0, 1
_MOST_WAITING = 48  # accepted frames that have not begun: 5 ms of a full bus, so that ticks may be late
_MOST_UNREAD = 100_000  # frames that the endpoint has not taken: it takes none while a fault keeps its bus off
_SETTLE_NS = 250_000_000  # python-can cannot parse an answer of the handshake if a frame follows too soon
_PLACES = Places(total=32, per_address=16)
_REFUSAL = b"< error too many clients >"
_CLOSE_TURNS, _CLOSE_TURN_S = 1000, 0.001  # clients get one second to read the rest


@dataclass(frozen=True)
class _Member:
    """Connection, and the time since which it receives frames (None: it does not)."""

    client: BusClient
    seat: Seat
    listens_ns: int | None = None

    def listens(self, t_ns: int) -> bool:
        """Return True if the client receives a frame that was sent at `t_ns`."""
        return self.listens_ns is not None and t_ns >= self.listens_ns and self.client.wants_frames


class ServedBus(CanBus):
    """Served bus with all its clients."""

    def __init__(self, parameters: CanLink, clock: Clock) -> None:
        self._parameters = parameters
        self._clock = clock
        self._wire = Wire(parameters.rates)
        self._admission = Admission(AllowList(parameters.allow), _PLACES)
        self._listener = Listener(self._admission, self._welcome, _REFUSAL)
        self._members: dict[int, _Member] = {}
        self._nodes = itertools.count(2)
        self._unread: deque[TimedFrame] = deque(maxlen=_MOST_UNREAD)
        self._wall_offset_ns = time.time_ns() - time.monotonic_ns()
        self._counts: Counter[str] = Counter()
        self._attend: Callable[[], None] = lambda: None
        self.missed = 0

    @property
    def address(self) -> str:
        """Host and port."""
        host, port = self._listener.address or (self._parameters.host, self._parameters.port)
        return f"{host}:{port}"

    @property
    def waiting(self) -> int:
        """Number of our ordinary frames that have not begun."""
        return self._wire.waiting(_ORDINARY)

    @property
    def is_busy(self) -> bool:
        """True while frames are on the bus or wait for it."""
        return self._wire.busy or self.waiting > 0

    def serve(self, attend: Callable[[], None]) -> None:
        """Receive the function to call when another node has sent a frame."""
        self._attend = attend

    @property
    def has_listeners(self) -> bool:
        """True while any client listens: a frame without a receiver is not acknowledged, and so never completes."""
        now_ns = self._clock.now_ns()
        return any(member.listens(now_ns) for member in self._members.values())

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of clients that were refused or disconnected."""
        return self._counts + self._admission.counts

    async def open(self) -> None:
        """Listen on the port; raises BusDown if the port cannot be opened."""
        try:
            self._listener.open(self._parameters.host, self._parameters.port)
        except OSError as error:
            raise BusDown(*error.args) from error

    def send(self, frame: Frame, *, urgent: bool = False) -> bool:
        """Pass a frame to the bus; return False if there is no room now."""
        node = -1 - frame.identifier if urgent else _ORDINARY  # a transmit buffer for each urgent identifier
        if self._wire.waiting(node) >= _MOST_WAITING:
            return False
        now_ns = self._clock.now_ns()
        self._carry(now_ns)
        self._wire.offer(node, frame, now_ns)
        return True

    def flood(self, frame: Frame, t_ns: int) -> None:
        """Put a frame of a foreign node on the bus at `t_ns`."""
        self._wire.offer(_STRANGER, frame, t_ns)

    def take(self) -> list[TimedFrame]:
        """Return the frames since the last call."""
        self._carry(self._clock.now_ns())
        received = list(self._unread)
        self._unread.clear()
        return received

    def discard(self) -> None:
        """Discard our ordinary frames that have not begun; a frame that has begun is not interrupted."""
        self._wire.forget(_ORDINARY)

    async def close(self) -> None:
        """Finish the frame on the wire; disconnect clients that have read everything, all of them after a second."""
        await self._listener.close()
        await self._until(lambda: not self._wire.busy)
        for member in self._members.values():
            member.client.close()
        await self._until(lambda: not self._members)
        for member in self._members.values():
            self.missed += member.client.unsent_lines
            member.client.abort()
        await self._until(lambda: not self._members)

    # Calls of the connections of clients.

    def joined(self, client: BusClient) -> None:
        """Store a client, and begin to send it frames if it has requested them."""
        member = self._members[client.node]
        self._admission.settle(member.seat)
        if client.wants_frames and member.listens_ns is None:
            self._members[client.node] = _Member(client, member.seat, self._clock.now_ns() + _SETTLE_NS)

    def offer(self, client: BusClient, frames: list[Frame]) -> int:
        """Put a client's frames on the wire; return the number of its waiting frames."""
        self._attend()
        now_ns = self._clock.now_ns()
        self._carry(now_ns)
        for frame in frames:
            self._wire.offer(client.node, frame, now_ns)
        self._carry(now_ns)
        return self._wire.waiting(client.node)

    def slow(self, client: BusClient) -> None:
        """Count a client that is disconnected because it does not read."""
        self._counts["slow clients disconnected"] += 1

    def left(self, client: BusClient) -> None:
        """Remove a client and its frames that have not begun."""
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
        """Advance the wire, and send its frames to all clients."""
        for carried in self._wire.advance(now_ns):
            if carried.node != _ORDINARY:
                self._unread.append(TimedFrame(carried.frame, carried.end_ns, is_ours=carried.node < _ORDINARY))
            if carried.node in self._members:
                self._members[carried.node].client.resume(self._wire.waiting(carried.node))
            if not self._members:
                continue
            line = frame_line(carried.frame, (carried.end_ns + self._wall_offset_ns) // 1000)
            for member in self._members.values():
                if member.client.node != carried.node and member.listens(carried.end_ns):
                    self.missed += not member.client.send_line(line)
