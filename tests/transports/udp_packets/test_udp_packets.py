"""An instrument behind UDP ports: telecommands, senders, faults, and what is counted of each."""

import asyncio
import socket
from contextlib import closing
from functools import partial

import numpy as np
import pytest
from spacepackets.ecss.tc import PusTc

from emulator.rig.loading import RigError, parse_rig
from evstim.testing.link_contract import event_stream
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Ping, SetTick, Stop
from firmware_protocol.receiver.instrument import SerialReceiver
from tests.transports.network_streams.stream_readers import udp_port
from transports.faults.datagrams import LateDatagrams, LostDatagrams, RepeatedDatagrams
from transports.faults.line import BitFlips, Stall
from transports.faults.script import FaultPlan
from transports.link.endpoint import LinkFactory
from transports.link.kind import Wiring, possible_faults
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing
from transports.network import DatagramInlet
from transports.udp_packets.endpoint import Ports, UdpPacketEndpoint, listen_udp
from transports.udp_packets.kind import UDP_PACKETS, UdpPacketsLink

pytestmark = pytest.mark.socket

BLOCK_EVENTS = 50
TICK_NS = 500_000


class Bench:
    """A link on a clock that the test moves, and the socket that its packets come to."""

    def __init__(self, faults=(), **more):
        self.clock = FakeClock(1_000_000_000)
        self.ring = EventRing(100_000)
        self.socket = udp_port()
        self.socket.setblocking(False)
        parameters = UdpPacketsLink(**{"port": self.socket.getsockname()[1], "command_port": 0, **more})
        settings = InstrumentSettings(housekeeping_s=0, block_events=BLOCK_EVENTS)
        factory = LinkFactory(UdpPacketEndpoint, parameters, Wiring(FaultPlan("udp", scripted=tuple(faults), seed=1)))
        self.link = Link(LinkSetup("udp", self.ring, partial(Instrument, (346, 260), settings), factory), self.clock)
        self.receiver = SerialReceiver("ccsds")
        self.datagrams, self.told, self.closed = [], [], False
        asyncio.run(self.link.endpoint.start())
        self.ring.start(FREE_RUNNING)

    @property
    def commands_at(self):
        host, port = self.link.endpoint.report().address.split(":")
        return host, int(port)

    def send(self, octets):
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(octets, self.commands_at)

    def give(self, events):
        self.ring.push(events)
        self.ring.publish(int(events["t"][-1]) + 1)

    def run(self, ticks=4):
        for _ in range(ticks):
            self.clock.advance(TICK_NS)
            self.link.tick()
        self.take()

    def take(self):
        try:
            while True:
                self.datagrams.append(self.socket.recv(65_536))
                self.receiver.push(self.datagrams[-1])
        except BlockingIOError:
            self.told += self.receiver.take_reports()

    def unplug(self):
        """Close the link, and take what it says at last."""
        asyncio.run(self.link.close())
        self.take()
        self.closed = True

    def close(self):
        if not self.closed:
            self.unplug()
        self.socket.close()


@pytest.fixture
def bench(at_end):
    return lambda *faults, **more: at_end.enter_context(closing(Bench(faults, **more)))


def test_a_telecommand_of_another_library_is_done_and_answered(bench):
    b = bench()
    b.send(bytes(PusTc(service=17, message_subtype=1, apid=0x2A0, seq_count=3, ack_flags=0b1001).pack()))
    b.run()
    assert [tuple(one[7:9]) for one in b.datagrams] == [(1, 1), (17, 2), (1, 7)]
    assert b.datagrams[0][20:24] == bytes.fromhex("1aa0c003")
    assert b.link.report().counts["telecommands"] == 1


def test_several_telecommands_in_a_datagram_are_done_in_order(bench):
    b = bench()
    b.send(b"".join(b.receiver.wrap(command) for command in (Ping(), SetTick(100), Stop())))
    b.run()
    assert [one for one in b.told if "completion" in one] == [
        f"{n}: completion good" for n in ("Ping", "SetTick", "Stop")
    ]
    assert b.link._device.tick_us == 100


@pytest.mark.parametrize(
    ("octets", "refused"),
    [(b"", 0), (b"\x18", 1), (bytes(5), 1), (b"\xff" * 2000, 1), (bytes.fromhex("1aa0c0000006291101000081e8"), 1)],
)
def test_octets_that_are_no_telecommand_are_counted_and_stop_nothing(bench, octets, refused):
    b = bench()
    b.send(octets)
    b.send(b.receiver.wrap(Ping()))
    b.run()
    assert b.told == ["Ping: acceptance good", "pong", "Ping: completion good"]
    assert b.link.report().counts.get("damaged_frames", 0) == refused


def test_a_cut_packet_behind_a_whole_one_costs_only_itself(bench):
    b = bench()
    ping = b.receiver.wrap(Ping())
    b.send(ping + ping[:-1])
    b.run()
    assert "Ping: completion good" in b.told
    assert b.link.report().counts["damaged_frames"] == 1


def test_senders_that_are_not_allowed_are_counted_and_not_heard(bench):
    b = bench(allow=("10.0.0.5",))
    b.send(b.receiver.wrap(Ping()))
    b.run()
    assert b.told == []
    assert b.link.report().counts == {"telecommands of senders not allowed": 1}


def test_a_flood_is_taken_a_little_at_a_time(bench):
    b = bench()
    ping = Profile("ccsds").wrap_command(Ping())
    for _ in range(150):
        b.send(ping)
    b.run(1)
    assert 0 < b.link.report().counts["telecommands"] <= 64
    b.run(4)
    assert b.link.report().counts["telecommands"] == 150


def test_nobody_listens_is_counted(bench):
    b = bench()
    b.socket.close()
    b.give(event_stream(2000))
    for _ in range(4):
        b.clock.advance(TICK_NS)
        b.link.tick()
    assert b.link.report().counts["datagrams refused: no program listens"] > 0
    assert b.link.report().delivered == 2000
    b.socket = udp_port()
    b.socket.setblocking(False)


def test_a_rate_is_kept(bench):
    b = bench(mbit_s=0.8)  # 100 bytes a millisecond, after a burst of 1500
    b.give(event_stream(20_000))
    b.run(1)
    first = sum(map(len, b.datagrams))
    b.run(200)
    assert 1500 <= first <= 1500 + 1100
    assert sum(map(len, b.datagrams)) == pytest.approx(first + 200 * 50, rel=0.05)


def counts_of(datagrams):
    return [int.from_bytes(one[2:4], "big") & 0x3FFF for one in datagrams]


def ledger(b, count):
    """The sums of a link that was given `count` events; return what a receiver has and what the faults destroyed."""
    report = b.link.report()
    destroyed = sum(one.events_lost for one in report.faults)
    assert report.delivered + report.dropped + report.dropped_in_device == count
    assert report.delivered == count - destroyed
    return b.receiver.take_events(), destroyed


def test_lost_datagrams_are_missing_in_the_count_and_in_the_ledger(bench):
    b = bench(LostDatagrams(rate=0.2, count=7))
    b.give(event_stream(100 * BLOCK_EVENTS))
    b.run(20)
    events, destroyed = ledger(b, 100 * BLOCK_EVENTS)
    assert destroyed == 7 * BLOCK_EVENTS == 100 * BLOCK_EVENTS - len(events)
    counts = counts_of(b.datagrams)
    assert b.receiver.counts["messages_missing"] == counts[-1] + 1 - counts[0] - 93 > 0
    assert len(counts) == 93
    assert [(one.hits, one.touched) for one in b.link.report().faults] == [(7, 7)]


def test_late_datagrams_are_overtaken_and_not_lost(bench):
    b = bench(LateDatagrams(rate=0.05, count=4, overtaken_by=2))
    sent = event_stream(100 * BLOCK_EVENTS)
    b.give(sent)
    b.run(20)
    events, destroyed = ledger(b, 100 * BLOCK_EVENTS)
    assert destroyed == 0
    assert not np.array_equal(events, sent)
    assert np.array_equal(np.sort(events, order="t"), sent)
    counts = counts_of(b.datagrams)
    late = [count for n, count in enumerate(counts) if count < max(counts[:n], default=0)]
    assert len(late) == b.link.report().faults[0].hits >= 3
    for count in late:
        before = counts[: counts.index(count)]
        assert len([other for other in before if other > count and other not in late]) == 2


def test_a_late_datagram_at_the_end_leaves_when_the_link_closes(bench):
    b = bench(LateDatagrams())
    b.give(event_stream(BLOCK_EVENTS))
    b.run()
    assert b.datagrams == []
    b.unplug()
    assert len(b.receiver.take_events()) == BLOCK_EVENTS
    assert b.link.report().delivered == BLOCK_EVENTS


def test_faults_that_meet_leave_each_message_one_fate(bench):
    b = bench(
        RepeatedDatagrams(rate=0.3, count=0, for_s=10.0),
        LateDatagrams(rate=0.3, count=0, for_s=10.0, overtaken_by=3),
        BitFlips(rate=1e-3, count=0, for_s=10.0),
        LostDatagrams(rate=0.3, count=0, for_s=10.0),
    )
    b.give(event_stream(300 * BLOCK_EVENTS))
    b.run(60)
    b.unplug()
    events, destroyed = ledger(b, 300 * BLOCK_EVENTS)
    assert len(np.unique(events)) == 300 * BLOCK_EVENTS - destroyed
    assert destroyed > 50 * BLOCK_EVENTS


def test_a_fault_of_a_serial_line_is_refused(bench):
    with pytest.raises(ValueError, match="no fault of packets in datagrams"):
        bench().link.endpoint.faulty.inject(Stall())
    assert set(possible_faults(UDP_PACKETS, UdpPacketsLink())) == {
        "lost_datagrams",
        "repeated_datagrams",
        "late_datagrams",
        "bit_flips",
    }


def test_a_port_that_is_taken_says_so():
    with udp_port() as taken:
        host, port = taken.getsockname()
        with pytest.raises(OSError, match=f"cannot listen on {host} port {port}"):
            DatagramInlet(host, port).open()


@pytest.mark.parametrize(
    ("keys", "told"),
    [
        ('host = "10.1.2.3"', "elsewhere = true"),
        ('command_host = "0.0.0.0"', "set allow, for example"),
        ('command_host = ""', "command_host is empty"),
        ("port = 0", "port must be 1"),
        ("port = 10025", "are the same"),
        ("mbit_s = 0.0", "mbit_s must be"),
        ('allow = ["nobody"]', "neither an address nor a network"),
    ],
)
def test_a_rig_that_makes_no_sense_is_refused(keys, told):
    with pytest.raises(RigError, match=told):
        parse_rig(f'[scene]\nkind = "checkerboard"\n[[links]]\nkind = "udp_packets"\n{keys}\n', "a.toml", "a")


def test_the_listener_reads_tells_and_counts(bench):
    b = bench()
    port = b.socket.getsockname()[1]
    b.socket.close()
    b.give(event_stream(500))
    seen = []

    class Moving(FakeClock):
        def sleep_until(self, time_ns):
            b.clock.advance(TICK_NS)
            b.link.tick()

    ports = Ports(port=port, command_port=b.commands_at[1])
    reception = listen_udp(
        ports, lambda now: seen.append(now) or len(seen) < 20, Moving(0), commands=[Ping(), SetTick(10)]
    )
    assert (reception.events, reception.faults, reception.digest) == (500, 0, b.link.report().digest)
    assert reception.answer_texts[-1] == "SetTick: completion good"
    b.socket = udp_port()
    b.socket.setblocking(False)
