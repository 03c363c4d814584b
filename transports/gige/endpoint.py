"""A GigE Vision camera: a process that answers hosts, and the stream.

    hosts --GVCP--> ControlProcess --orders--> Triton2.obey
    Triton2.next_block --packets--> faults --> StreamSocket --> the host that has control

UDP has no back-pressure: a block counts as delivered when the kernel has taken all its packets.

What became of blocks that were sent, when faults on the way took packets from them and hosts asked for these again.

    block left --> whole? --> arrived, in order
                   packets missing --> sent again in time --> arrived
                                       not ---------------> destroyed by the fault

A host gets blocks in order: those behind a block with missing packets wait for its fate.
"""

from __future__ import annotations

import ipaddress
import logging
from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from dataclasses import dataclass, field

from firmware_protocol.gige.gvsp import HEADER_OCTETS
from firmware_protocol.gige.outflow import Outgoing
from firmware_protocol.gige.triton2 import Triton2
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, FaultRecord
from transports.gige.answering import ControlProcess, ControlSetup, Move, Mute, Release
from transports.gige.kind import GigeLink
from transports.gige.packet_faults import FaultyPackets, Packet
from transports.gige.sockets import StreamSocket
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.network.datagrams import AllowList, ByteBudget

__all__ = ["BlockFates", "GigeEndpoint", "GigeFactory"]


_PATIENCE_NS = 200_000_000  # Aravis gives a block up 100 ms after its last packet


@dataclass
class _Left:
    outgoing: Outgoing
    at_ns: int
    missing: set[int] = field(default_factory=set)


class BlockFates:
    """Tells `arrived` and `destroyed` of each block once, in the order in which they left."""

    def __init__(self, arrived: Callable[[Outgoing], None], destroyed: Callable[[Outgoing], None]) -> None:
        self._arrived = arrived
        self._destroyed = destroyed
        self._waiting: deque[_Left] = deque()
        self._missing: dict[int, set[int]] = {}

    def missed(self, block: int, packet: int) -> None:
        """Say that a packet was taken away, before or after its block has left."""
        self._missing.setdefault(block, set()).add(packet)

    def came(self, block: int, packet: int) -> None:
        """Say that a packet arrived after all."""
        self._missing.get(block, set()).discard(packet)

    def left(self, outgoing: Outgoing, now_ns: int) -> None:
        """Say that all packets of a block have left the camera."""
        missing = self._missing.get(outgoing.block.number)
        if not missing and not self._waiting:
            self._arrived(outgoing)
        else:
            self._waiting.append(_Left(outgoing, now_ns, missing or set()))

    def settle(self, now_ns: int, *, final: bool = False) -> None:
        """Tell the fates that are known by now; at the end, all of them."""
        while self._waiting:
            first = self._waiting[0]
            if first.missing and not final and now_ns - first.at_ns < _PATIENCE_NS:
                return
            self._waiting.popleft()
            self._missing.pop(first.outgoing.block.number, None)
            (self._destroyed if first.missing else self._arrived)(first.outgoing)


log = logging.getLogger(__name__)

_IP_UDP_OCTETS = 28
_BURST_NS = 1_000_000  # with one block, at 1 Gbit/s, three quarters of a stock socket buffer: a packet takes 2304 there


@dataclass(frozen=True)
class GigeFactory(EndpointFactory[Triton2]):
    """Puts a camera behind a control port."""

    link: GigeLink
    faults: FaultPlan = field(default_factory=FaultPlan)

    def build(self, device: Triton2, deliveries: Deliveries) -> GigeEndpoint:
        """Return the endpoint, its sockets not yet open."""
        return GigeEndpoint(self, device, deliveries)


@dataclass(frozen=True)
class _Way:
    """How packets go: to whom, None for nobody who may get them; whether they may be cut; with which pause."""

    to: tuple[str, int] | None = None
    may_fragment: bool = False
    pause_ns: int = 0


class GigeEndpoint(Endpoint):
    """One camera, the hosts that look at it, and the one that receives."""

    def __init__(self, factory: GigeFactory, camera: Triton2, deliveries: Deliveries) -> None:
        self._link = link = factory.link
        self._host = link.host
        self._camera = camera
        self._deliveries = deliveries
        self._clock = deliveries.clock
        self._control: ControlProcess | None = None
        self._allow = AllowList(link.allow)
        self._stream = StreamSocket(link.host, segmented=link.segmentation)
        self._budget = ByteBudget(link.mbit_s, self._clock.now_ns(), _BURST_NS)
        self._faulty = FaultyPackets(factory.faults)
        self._fates = BlockFates(self._arrived, self._destroyed)
        self._going: tuple[Outgoing, Iterator[Packet]] | None = None
        self._ready: deque[Packet] = deque()
        self._whole = True
        self._way = _Way()
        self._message_way: tuple[str, int] | None = None
        self._next_ns = 0
        self._patience_ns = link.block_us * 1000
        self._moved = 0, self._clock.now_ns()
        self._time_stands = self._is_down = False
        self.sent: Counter[str] = Counter()

    async def start(self) -> None:
        """Open the sockets; raises OSError, with what to do, when an address cannot be used."""
        link = self._link
        port = self._stream.open()
        try:
            self._control = ControlProcess(ControlSetup(link.host, link.port, link.allow, self._camera.settings, port))
        except OSError:
            self._stream.close()
            raise

    def listen(self) -> None:
        """See `Endpoint.listen`; raises LinkBroken when nobody answers hosts any more."""
        assert self._control is not None
        orders = list(self._control.take())
        for order in orders:
            self._camera.obey(order)
        if orders:
            self._way = self._chosen_way()
            self._message_way = self._permitted(self._camera.message_destination)

    def pump(self) -> None:
        """Send what waits as far as the rate allows."""
        assert self._control is not None
        self._control.tell(self._camera.time)
        self._budget.renew(self._clock.now_ns())
        self._look_at_time()
        self._send_messages()
        while self._budget.left > 0 and (self._send_block() or (self._prepare() and self._send())):
            pass
        self._fates.settle(self._clock.now_ns())

    def advance_faults(self, stream_us: int) -> None:
        """See `Endpoint.advance_faults`."""
        self._ready += self._faulty.advance(stream_us)
        self._follow_faults()

    def inject(self, fault: Fault) -> None:
        """See `Endpoint.inject`."""
        self._faulty.inject(fault)
        self._follow_faults()

    @property
    def faults(self) -> tuple[FaultRecord, ...]:
        """See `Endpoint.faults`."""
        return self._faulty.records

    async def close(self) -> None:
        """Close the sockets; what has not left is lost."""
        if self._going is not None:
            self._camera.lost(self._going[0])
            self._going = None
        self._fates.settle(self._clock.now_ns(), final=True)
        self._faulty.close()
        self._camera.disconnected()
        if self._control is not None:
            self._control.close()
        self._stream.close()

    @property
    def state(self) -> str:
        """Who has control, and whether the stream runs."""
        owner = self._camera.owner
        if owner is None:
            return f"waiting on {self.address}"
        does = "streaming to" if self._camera.streaming else "controlled by"
        return f"{does} {owner[0]}:{owner[1]}"

    @property
    def address(self) -> str:
        """Where hosts find the camera."""
        return f"{self._host}:{self._link.port if self._control is None else self._control.port}"

    @property
    def counts(self) -> Mapping[str, int]:
        """Packets, requests, and what was wrong with either."""
        sent = self.sent + self._camera.messages.counts
        return sent if self._control is None else sent + self._control.counts

    def _follow_faults(self) -> None:
        """Do to the control channel, and to the camera's address, what faults do to them."""
        assert self._control is not None
        if (address := self._faulty.new_address()) is not None:
            self._move(self._control, address)
        if self._faulty.link_is_down != self._is_down:
            self._is_down = self._faulty.link_is_down
            self._control.order(Mute(self._is_down))
        if self._faulty.takes_control():
            self._control.order(Release())

    def _move(self, control: ControlProcess, address: str) -> None:
        """Have another address from now on; one that this machine does not have is told, and the camera stays."""
        stream = StreamSocket(address, segmented=self._link.segmentation)
        try:
            port = stream.open()
        except OSError as error:
            log.warning("ip_change: this machine has no %s (%s): back at %s", address, error.strerror, self._host)
            return
        self._stream.close()
        log.warning("ip_change: the camera has left %s and is at %s", self._host, address)
        self._stream, self._host = stream, address
        control.order(Move(address, port))

    def _look_at_time(self) -> None:
        """Find out whether stream time stands, as at the end of a run: what waits then leaves without growing."""
        now_ns = self._clock.now_ns()
        if self._camera.now_us != self._moved[0]:
            self._moved = self._camera.now_us, now_ns
        self._time_stands = now_ns - self._moved[1] >= self._patience_ns

    def _send_messages(self) -> None:
        """Tell the host what it wants to be told, and hear its answers."""
        messages, to = self._camera.messages, self._message_way
        if to is None:
            return
        for data, peer in self._stream.take():
            if peer == to:
                messages.answered(data)
        now_ns, settings = self._clock.now_ns(), self._camera.message_settings
        while not self._is_down and (message := messages.next(now_ns, settings)) is not None:
            with suppress(BlockingIOError):  # it is lost, as one on the way
                self._stream.send(message, to, may_fragment=self._way.may_fragment)

    def _send_block(self) -> bool:
        """Send a block in few calls; False when there is none, or packets must go one by one."""
        way, busy = self._way, self._going is not None or self._ready
        if busy or way.to is None or way.pause_ns or self._faulty.at_work or self._camera.waits_extra:
            return False
        outgoing = self._camera.next_block(at_once=self._time_stands)
        if outgoing is None:
            return False
        block = outgoing.block
        taken = self._stream.send_block(block, way.to, may_fragment=way.may_fragment)
        self.sent["packets"] += taken
        self._going, self._whole = (outgoing, _packets(outgoing, taken)), True
        if taken < block.packets:  # the others go one by one, and it is told why they do not
            self._budget.left -= taken * block.packet_size
            return False
        self._budget.left -= len(block.data) + taken * (HEADER_OCTETS + _IP_UDP_OCTETS)
        self._end_block()
        return True

    def _prepare(self) -> bool:
        """Have a packet ready; False when there is nothing to send, or nothing may go yet."""
        while not self._ready:
            if self._way.pause_ns and self._clock.now_ns() < self._next_ns:
                return False
            packet = self._next_packet()
            if packet is None:
                return False
            self._ready += self._faulty.change(packet)
            for gone in self._faulty.gone():
                self._fates.missed(gone.block, gone.number)
        return True

    def _next_packet(self) -> Packet | None:
        """Return the next packet of the camera: what a host asked for goes first, then the block that has begun."""
        asked = self._camera.next_extra()
        if asked is not None:
            return Packet(asked.data, asked.block, asked.number, again=asked.block > 0)
        while True:
            if self._going is None:
                outgoing = self._camera.next_block(at_once=self._time_stands)
                if outgoing is None:
                    return None
                self._going, self._whole = (outgoing, _packets(outgoing)), True
            packet = next(self._going[1], None)
            if packet is not None:
                return packet
            self._end_block()

    def _send(self) -> bool:
        """Send the packet that is ready; False when the kernel has no room now."""
        packet, way = self._ready[0], self._way
        try:
            left = way.to is not None and self._stream.send(packet.data, way.to, may_fragment=way.may_fragment)
        except BlockingIOError:
            return False
        self._ready.popleft()
        self._note(packet, left)
        return True

    def _note(self, packet: Packet, left: bool) -> None:
        """Count a packet and what it takes from the rate."""
        self.sent["packets" if left else "packets that could not be sent"] += 1
        self._whole &= left
        if left and packet.block:
            self._fates.came(packet.block, packet.number)
        if left:
            self._budget.left -= len(packet.data) + _IP_UDP_OCTETS
            self._next_ns = self._clock.now_ns() + self._way.pause_ns if self._way.pause_ns else 0

    def _chosen_way(self) -> _Way:
        """Return how the camera's host wants its packets."""
        to = self._permitted(self._camera.destination)
        return _Way(to, self._camera.may_fragment, self._camera.packet_delay_ns)

    def _permitted(self, destination: tuple[int, int] | None) -> tuple[str, int] | None:
        """Return an address and port in the form of sockets; None where nothing may go there."""
        if destination is None:
            return None
        address = str(ipaddress.IPv4Address(destination[0]))
        return (address, destination[1]) if self._allow.permits(address) else None

    def _end_block(self) -> None:
        """Settle the block whose last packet has been made."""
        assert self._going is not None
        outgoing, self._going = self._going[0], None
        if self._whole:
            self._camera.sent(outgoing)
            self._fates.left(outgoing, self._clock.now_ns())
        else:
            self._camera.lost(outgoing)

    def _arrived(self, outgoing: Outgoing) -> None:
        self._deliveries.add(outgoing.events, self._camera.epoch_us, outgoing.edges)

    def _destroyed(self, outgoing: Outgoing) -> None:
        self._faulty.blame(len(outgoing.events), len(outgoing.edges))


def _packets(outgoing: Outgoing, first: int = 0) -> Iterator[Packet]:
    block = outgoing.block
    return (Packet(block.packet(number), block.number, number) for number in range(first, block.packets))
