"""Endpoint of a GigE Vision camera: a process that answers hosts, and the stream.

    hosts --GVCP--> ControlProcess --orders--> Triton2.obey
    Triton2.next_block --packets--> faults --> StreamSocket --> the host that has control

UDP has no back-pressure: a block counts as delivered when the kernel has taken all its packets.

`BlockFates` determines the fate of a block when faults removed some of its packets and hosts requested them again.

    block left --> whole? --> arrived, in order
                   packets missing --> sent again in time --> arrived
                                       not ---------------> destroyed by the fault

A host gets blocks in order: later blocks wait for the fate of a block with missing packets.

`ControlProcess` is the interface to the process that answers hosts:

    the link -- ControlSetup, Stop --------> transports.gige.answering
             -- device's clock ------------>      (shared memory)
             <- master's time --------------
             <- Listening, orders, counts --
"""

from __future__ import annotations

import fcntl
import ipaddress
import logging
import mmap
import os
import struct
import subprocess
import sys
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection

from firmware_protocol.gige.control import DeviceTime, Order
from firmware_protocol.gige.gvsp import HEADER_OCTETS
from firmware_protocol.imx636.triton2 import Outgoing, Triton2
from firmware_protocol.ptp.slave import Timebase
from transports.gige.answering import (
    TIME_CELLS,
    ControlSetup,
    Failed,
    Listening,
    Move,
    Mute,
    Release,
    Stop,
    read_timebase,
)
from transports.gige.kind import GigeLink
from transports.gige.packet_faults import FaultyPackets, Packet
from transports.gige.sockets import StreamSocket
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, HOSTED_NS, REST_NS, Endpoint, EndpointReport, LinkBroken
from transports.link.kind import Wiring
from transports.network import AllowList, ByteBudget

_START_S = 120.0  # enough for a very busy machine
_END_S = 10.0
_AT_A_TIME = 1024
_PIPE_OCTETS = 1 << 20  # holds the orders while a link is not running
_MAIN = "from transports.gige.answering import main; main()"
_TIME = struct.Struct("=q")


class ControlProcess:
    """Control channel of a camera in a separate process; `port`: its port; `counts`: requests by their result.

    Raises OSError, with the remedy, when it cannot be started or an address cannot be used.
    """

    def __init__(self, setup: ControlSetup) -> None:
        memory = os.memfd_create("evstim-gige-time")
        os.ftruncate(memory, 8 * TIME_CELLS)
        self._time = mmap.mmap(memory, 8 * TIME_CELLS)
        child_in, outgoing = os.pipe()
        incoming, child_out = os.pipe()
        with suppress(OSError):  # beyond this user's limit of pipe memory: a shorter pipe suffices
            fcntl.fcntl(incoming, fcntl.F_SETPIPE_SZ, _PIPE_OCTETS)
        self._outgoing, self._incoming = Connection(outgoing, readable=False), Connection(incoming, writable=False)
        self._process = _started(child_in, child_out, memory)
        for descriptor in (child_in, child_out, memory):
            os.close(descriptor)
        self.counts: Counter[str] = Counter()
        self._timebase: Timebase | None = None
        self._outgoing.send(setup)
        self.port = self._listening()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def orders(self) -> int:
        """Descriptor that is readable when orders wait."""
        return self._incoming.fileno()

    def take(self) -> Iterator[Order]:
        """Yield the orders of hosts; raises LinkBroken when the process has died, or cannot use its new address."""
        for _ in range(_AT_A_TIME):
            try:
                if not self._incoming.poll():
                    return
                message = self._incoming.recv()
            except (EOFError, ConnectionError) as error:
                how = f"exit code {self._process.wait(_END_S)}"
                raise LinkBroken(f"the process that answers GigE Vision hosts has died ({how})") from error
            if isinstance(message, Failed):
                raise LinkBroken(message.reason)
            if isinstance(message, Counter):
                self.counts = message
            else:
                yield message

    def write_time(self, time: DeviceTime) -> None:
        """Write the device's clock: see `read_time`."""
        _TIME.pack_into(self._time, 8, time.ns)
        _TIME.pack_into(self._time, 0, time.starts)

    @property
    def timebase(self) -> Timebase | None:
        """Relation of a master's time to CLOCK_MONOTONIC; None if the camera follows none."""
        self._timebase = read_timebase(self._time, self._timebase)
        return self._timebase

    def order(self, order: Mute | Release | Move) -> None:
        """Begin or end a fault of the control channel; a dead process is reported by `take`."""
        with suppress(ConnectionError):
            self._outgoing.send(order)

    def close(self) -> None:
        """End the process; its last counts are read, waiting orders are not."""
        try:
            self._outgoing.send(Stop())
            while True:
                message = self._incoming.recv()
                self.counts = message if isinstance(message, Counter) else self.counts
        except (EOFError, ConnectionError):
            self._end()

    def _listening(self) -> int:
        """Return the port; raises OSError when there is none."""
        try:
            message = self._incoming.recv() if self._incoming.poll(_START_S) else None
        except EOFError:
            message = None
        if isinstance(message, Listening):
            return message.port
        self._end()
        if isinstance(message, Failed):
            raise OSError(message.errno, message.reason)
        raise OSError("the process that answers GigE Vision hosts does not start; its output is above")

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._outgoing.close()
        self._incoming.close()
        self._time.close()


def _started(*descriptors: int) -> subprocess.Popen[bytes]:
    """Start the process in a separate session: Linux divides processors by session (autogroup)."""
    return subprocess.Popen(
        [sys.executable, "-c", _MAIN, *map(str, descriptors)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )


_PATIENCE_NS = 200_000_000  # Aravis discards an incomplete block 100 ms after its last packet


@dataclass
class _Left:
    outgoing: Outgoing
    at_ns: int
    missing: set[int] = field(default_factory=set)


class BlockFates:
    """Fates of blocks: calls `arrived` or `destroyed` once for each block, in the order in which they left."""

    def __init__(self, arrived: Callable[[Outgoing], None], destroyed: Callable[[Outgoing], None]) -> None:
        self._arrived = arrived
        self._destroyed = destroyed
        self._waiting: deque[_Left] = deque()
        self._missing: dict[int, set[int]] = {}

    def missed(self, block: int, packet: int) -> None:
        """Record that a packet was removed, before or after its block has left."""
        self._missing.setdefault(block, set()).add(packet)

    def came(self, block: int, packet: int) -> None:
        """Record that a removed packet arrived later."""
        self._missing.get(block, set()).discard(packet)

    def left(self, outgoing: Outgoing, now_ns: int) -> None:
        """Record that all packets of a block have left the camera."""
        missing = self._missing.get(outgoing.block.number)
        if not missing and not self._waiting:
            self._arrived(outgoing)
        else:
            self._waiting.append(_Left(outgoing, now_ns, missing or set()))

    def settle(self, now_ns: int, *, final: bool = False) -> None:
        """Report the fates that are known; at the end, all of them."""
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
class _Route:
    """Route of packets: destination (None: no host may receive them), permission to fragment, pause between packets."""

    to: tuple[str, int] | None = None
    may_fragment: bool = False
    pause_ns: int = 0


class GigeEndpoint(Endpoint):
    """Endpoint of one camera for all its hosts; one of them receives the stream."""

    faulty: FaultyPackets

    def __init__(self, link: GigeLink, wiring: Wiring, camera: Triton2, deliveries: Deliveries) -> None:
        self._link = link
        self._host = link.host
        self._camera = camera
        self._deliveries = deliveries
        self._clock = deliveries.clock
        self._control: ControlProcess | None = None
        self._allow = AllowList(link.allow)
        self._stream = StreamSocket(link.host, segmented=link.segmentation)
        self._budget = ByteBudget(link.mbit_s, self._clock.now_ns(), _BURST_NS)
        self.faulty = FaultyPackets(wiring.faults)
        self._fates = BlockFates(deliveries.add_items, self._destroyed)
        self._going: tuple[Outgoing, Iterator[Packet]] | None = None
        self._ready: deque[Packet] = deque()
        self._whole = True
        self._route = _Route()
        self._message_address: tuple[str, int] | None = None
        self._next_ns = 0
        self._patience_ns = link.block_us * 1000
        self._moved = 0, self._clock.now_ns()
        self._time_stands = self._is_down = False
        self.sent: Counter[str] = Counter()

    async def start(self) -> None:
        """Open the sockets; raises OSError, with the remedy, when an address cannot be used."""
        link = self._link
        port = self._stream.open()
        try:
            self._control = ControlProcess(ControlSetup(link.host, link.port, link.allow, self._camera.settings, port))
        except OSError:
            self._stream.close()
            raise

    def listen(self) -> None:
        """Process the orders of hosts; raises LinkBroken when the process that answers hosts has died."""
        assert self._control is not None
        self._follow_master(self._control)
        orders = list(self._control.take())
        for order in orders:
            self._camera.obey(order)
        if orders:
            to = self._permitted(self._camera.destination)
            self._route = _Route(to, self._camera.may_fragment, self._camera.packet_delay_ns)
            self._message_address = self._permitted(self._camera.message_destination)

    def pump(self) -> None:
        """Send the waiting packets as far as the rate permits."""
        assert self._control is not None
        self._follow_master(self._control)
        self._control.write_time(self._camera.time)
        self._budget.renew(self._clock.now_ns())
        self._detect_standstill()
        self._send_messages()
        while self._budget.left > 0 and (self._send_block() or (self._prepare() and self._send())):
            pass
        self._fates.settle(self._clock.now_ns())

    @property
    def inputs(self) -> Sequence[int]:
        """Descriptors that are readable when a request has arrived."""
        return () if self._control is None else (self._control.orders,)

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`; a host that has control reads the clock that `pump` writes."""
        if self._going is not None or self._ready or self._camera.waits_extra or self._camera.waiting_items:
            return BUSY_NS
        return REST_NS if self._camera.owner is None else HOSTED_NS

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due."""
        self._ready += self.faulty.advance(stream_us)
        self._follow_faults()

    async def close(self) -> None:
        """Close the sockets; packets that have not left are lost."""
        if self._going is not None:
            self._camera.lost(self._going[0])
            self._going = None
        self._fates.settle(self._clock.now_ns(), final=True)
        self.faulty.close()
        self._camera.disconnected()
        if self._control is not None:
            self._control.close()
        self._stream.close()

    @property
    def state(self) -> str:
        """Host that has control, and the state of the stream."""
        owner = self._camera.owner
        if owner is None:
            return f"waiting on {self._address}"
        does = "streaming to" if self._camera.streaming else "controlled by"
        return f"{does} {owner[0]}:{owner[1]}"

    def report(self) -> EndpointReport:
        """Return the address, evstim's own receiver while no host has control, and counts of packets and requests."""
        counts = self.sent + self._camera.messages.counts
        if self._control is not None:
            counts += self._control.counts
        attach = f"evstim listen gige {self._address}" if self._camera.owner is None else ""
        return EndpointReport(self._address, attach, counts=counts)

    @property
    def _address(self) -> str:
        return f"{self._host}:{self._link.port if self._control is None else self._control.port}"

    def _follow_master(self, control: ControlProcess) -> None:
        """Give the camera the difference of its master's time and its own, if the run has the pace of real time."""
        if not self._link.ptp:
            return
        now_ns = self._clock.now_ns()
        timebase, device_ns = control.timebase, self._deliveries.device_ns(now_ns)
        self._camera.follow(None if timebase is None or device_ns is None else timebase.at(now_ns) - device_ns)

    def _follow_faults(self) -> None:
        """Apply faults to the control channel and to the camera's address."""
        assert self._control is not None
        if (address := self.faulty.new_address()) is not None:
            self._move(self._control, address)
        if self.faulty.link_is_down != self._is_down:
            self._is_down = self.faulty.link_is_down
            self._control.order(Mute(self._is_down))
        if self.faulty.takes_control():
            self._control.order(Release())

    def _move(self, control: ControlProcess, address: str) -> None:
        """Change the address; one that this machine does not have is logged, and the camera stays."""
        stream = StreamSocket(address, segmented=self._link.segmentation)
        try:
            port = stream.open()
        except OSError as error:
            log.warning(
                "ip_change: this machine has no %s (%s): the camera stays at %s", address, error.strerror, self._host
            )
            return
        self._stream.close()
        log.warning("ip_change: the camera has left %s and is at %s", self._host, address)
        self._stream, self._host = stream, address
        control.order(Move(address, port))

    def _detect_standstill(self) -> None:
        """Detect that stream time stands still, as at a run's end: waiting blocks are then sent without more events."""
        now_ns = self._clock.now_ns()
        if self._camera.now_us != self._moved[0]:
            self._moved = self._camera.now_us, now_ns
        self._time_stands = now_ns - self._moved[1] >= self._patience_ns

    def _send_messages(self) -> None:
        """Send the messages that the host has requested, and read its answers."""
        messages, to = self._camera.messages, self._message_address
        if to is None:
            return
        for data, peer in self._stream.take():
            if peer == to:
                messages.answered(data)
        now_ns, settings = self._clock.now_ns(), self._camera.message_settings
        while not self._is_down and (message := messages.next(now_ns, settings)) is not None:
            with suppress(BlockingIOError):  # it is lost, like a datagram lost on the network
                self._stream.send(message, to, may_fragment=self._route.may_fragment)

    def _send_block(self) -> bool:
        """Send a block in few calls; return False when there is none, or packets must be sent one by one."""
        route, busy = self._route, self._going is not None or self._ready
        if busy or route.to is None or route.pause_ns or self.faulty.active or self._camera.waits_extra:
            return False
        outgoing = self._camera.next_block(at_once=self._time_stands)
        if outgoing is None:
            return False
        block = outgoing.block
        taken = self._stream.send_block(block, route.to, may_fragment=route.may_fragment)
        self.sent["packets"] += taken
        self._going, self._whole = (outgoing, _packets(outgoing, taken)), True
        if taken < block.packets:  # the others are sent one by one, which reports the reason
            self._budget.left -= taken * block.packet_size
            return False
        self._budget.left -= len(block.data) + taken * (HEADER_OCTETS + _IP_UDP_OCTETS)
        self._end_block()
        return True

    def _prepare(self) -> bool:
        """Prepare a packet; return False when there is none, or none may be sent yet."""
        while not self._ready:
            if self._route.pause_ns and self._clock.now_ns() < self._next_ns:
                return False
            packet = self._next_packet()
            if packet is None:
                return False
            self._ready += self.faulty.change(packet)
            for gone in self.faulty.gone():
                self._fates.missed(gone.block, gone.number)
        return True

    def _next_packet(self) -> Packet | None:
        """Return the next packet of the camera: packets requested by a host first, then those of the current block."""
        extra = self._camera.next_extra()
        if extra is not None:
            return Packet(extra.data, extra.block, extra.number, again=extra.block > 0)
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
        """Send the prepared packet; return False when the kernel has no room now."""
        packet, route = self._ready[0], self._route
        try:
            left = route.to is not None and self._stream.send(packet.data, route.to, may_fragment=route.may_fragment)
        except BlockingIOError:
            return False
        self._ready.popleft()
        self._note(packet, left)
        return True

    def _note(self, packet: Packet, left: bool) -> None:
        """Count a packet and its share of the rate."""
        self.sent["packets" if left else "packets that could not be sent"] += 1
        self._whole &= left
        if left and packet.block:
            self._fates.came(packet.block, packet.number)
        if left:
            self._budget.left -= len(packet.data) + _IP_UDP_OCTETS
            self._next_ns = self._clock.now_ns() + self._route.pause_ns if self._route.pause_ns else 0

    def _permitted(self, destination: tuple[int, int] | None) -> tuple[str, int] | None:
        """Return an address and port in the form of sockets; None if no data may be sent there."""
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

    def _destroyed(self, outgoing: Outgoing) -> None:
        self.faulty.attribute(len(outgoing.events), len(outgoing.edges))


def _packets(outgoing: Outgoing, first: int = 0) -> Iterator[Packet]:
    block = outgoing.block
    return (Packet(block.packet(number), block.number, number) for number in range(first, block.packets))
