"""Endpoint of an instrument that sends packets in datagrams and receives telecommands in datagrams, and a receiver.

    instrument.next_message -> profile.wrap -> faults -> outlet
    instrument.command <- unwrapper <- whole packets <- inlet

UDP has no back-pressure, and the receiver is not visible: a message counts as delivered when the kernel has taken its
datagram. The receiver detects missing packets by their sequence counts.

`listen_udp` is a computer that receives an instrument's packets until it is stopped, and may send telecommands.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import closing
from dataclasses import dataclass

from firmware_protocol.instrument.instrument import Instrument, Outgoing
from firmware_protocol.packets.ccsds import whole_packets
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Telecommand
from transports.faults.datagrams import FaultyDatagrams
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, HOSTED_NS, Endpoint, EndpointReport
from transports.link.kind import Wiring
from transports.link.pacing import Clock
from transports.network import ByteBudget, DatagramInlet, DatagramOutlet
from transports.reception import InstrumentReception, Receiving, receive
from transports.recording.record import Recorder
from transports.udp_packets.kind import UdpPacketsLink

_AT_A_TIME = 64


class UdpPacketEndpoint(Endpoint):
    """Endpoint of one instrument for one receiver."""

    faulty: FaultyDatagrams

    def __init__(self, link: UdpPacketsLink, wiring: Wiring, instrument: Instrument, deliveries: Deliveries) -> None:
        self._instrument = instrument
        self._clock = deliveries.clock
        self._profile = Profile("ccsds")
        self._commands = self._profile.command_unwrapper()
        self._outlet = DatagramOutlet(link.host, link.port)
        self._inlet = DatagramInlet(link.command_host, link.command_port, link.allow)
        self._budget = ByteBudget(link.mbit_s, self._clock.now_ns())
        self.faulty = FaultyDatagrams(wiring.faults, deliveries.add_items)
        self._next: tuple[bytes, Outgoing] | None = None

    async def start(self) -> None:
        """Open the sockets; raises OSError, with the remedy, when an address cannot be used."""
        self._inlet.open()
        try:
            self._outlet.open()
        except OSError:
            self._inlet.close()
            raise

    def pump(self) -> None:
        """Process received datagrams, and send the waiting messages as far as the rate permits."""
        self._receive()
        self._budget.renew(self._clock.now_ns())
        while self._budget.left > 0 and self._prepare() and self._send():
            pass
        self.faulty.flush(self._outlet.send)

    @property
    def inputs(self) -> Sequence[int]:
        """Descriptors that are readable when a request has arrived."""
        return self._inlet.descriptors

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`."""
        return BUSY_NS if self._next is not None or self._instrument.waiting_items else HOSTED_NS

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end the faults of the rig that are due."""
        self.faulty.advance(stream_us)

    async def close(self) -> None:
        """Close the sockets; messages that have not left are lost."""
        if self._next is not None:
            self._instrument.lost(self._next[1])
            self._next = None
        self.faulty.release(self._outlet.send)
        self.faulty.close()
        self._instrument.disconnected()
        self._inlet.close()
        self._outlet.close()

    @property
    def state(self) -> str:
        """Destination of the datagrams, and address for telecommands."""
        sent = self._outlet.counts["datagrams"]
        return f"{sent} datagrams to {self._outlet.address}, telecommands at {self._inlet.address}"

    def report(self) -> EndpointReport:
        """Return the address for telecommands, and counts of telecommands and datagrams, and of errors in either."""
        counts = {
            "telecommands": self._commands.counters.packets,
            "damaged_frames": self._instrument.frames_refused,
            "telecommands of senders not allowed": self._inlet.refused,
            "false_messages": self.faulty.false,
        }
        return EndpointReport(self._inlet.address, counts=+(self._outlet.counts + Counter(counts)))

    def _receive(self) -> None:
        """Process the datagrams of the other side; the only input."""
        for datagram in self._inlet.take(_AT_A_TIME):
            for packet in whole_packets(datagram):
                for received in self._commands.push(packet):
                    self._instrument.command(received)
        counters = self._commands.counters
        self._instrument.frames_refused = sum(counters.frames.refused.values()) + sum(counters.refused.values())

    def _prepare(self) -> bool:
        """Prepare a datagram; return False when there is nothing to send."""
        if self._next is None:
            outgoing = self._instrument.next_message()
            self._next = None if outgoing is None else (self._profile.wrap(outgoing.message), outgoing)
        return self._next is not None

    def _send(self) -> bool:
        """Send the prepared datagram through the faults; return False when the kernel accepts none now."""
        assert self._next is not None
        data, outgoing = self._next
        left = self.faulty.send(data, outgoing, self._outlet.send)
        if left is None:
            return False
        self._next = None
        self._budget.left -= len(data)
        (self._instrument.sent if left else self._instrument.lost)(outgoing)
        return True


_LOOK_PERIOD_NS = 500_000
_RECEIVE_BUFFER = 1 << 22
_AT_A_TIME_LISTENER = 1024


@dataclass(frozen=True)
class Ports:
    """Address for packets, and the camera's address for telecommands; `allow` as in a rig, for senders of packets."""

    host: str = "127.0.0.1"
    port: int = 10_015
    command_host: str = "127.0.0.1"
    command_port: int = 10_025
    allow: tuple[str, ...] = ()


def listen_udp(
    ports: Ports,
    goes_on: Callable[[InstrumentReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
    commands: Sequence[Telecommand] = (),
) -> InstrumentReception:
    """Open the port, send `commands`, and read while `goes_on`, called after each turn, returns True.

    Raises OSError when the port cannot be opened. The loss of the camera is not detected.
    """
    receiving = Receiving("ccsds", clock, recorder)

    def turn() -> None:
        for datagram in inlet.take(_AT_A_TIME_LISTENER):
            for packet in whole_packets(datagram):
                receiving.take(packet)
        clock.sleep_until(clock.now_ns() + _LOOK_PERIOD_NS)

    with closing(DatagramInlet(ports.host, ports.port, ports.allow)) as inlet:
        inlet.open(_RECEIVE_BUFFER)
        if commands:
            with closing(DatagramOutlet(ports.command_host, ports.command_port)) as outlet:
                outlet.open()
                for command in commands:
                    outlet.send(receiving.receiver.wrap(command))
        receive(lambda: receiving.now, goes_on, turn)
    return receiving.finish(gone=False)
