"""A GigE Vision camera on its sockets, and its host: who may come, faults and packets sent again, what ends it."""

import asyncio
import socket
import struct
import time
from functools import partial

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from firmware_protocol.edges import EdgeKind
from firmware_protocol.events import EVENT
from firmware_protocol.gige.bootstrap import Register
from firmware_protocol.gige.evs_registers import COLUMNS, ROWS, Erc, Evs
from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.settings import GigeSettings
from firmware_protocol.gige.triton2 import Triton2
from transports.faults.datagram_kinds import LateDatagrams, LostDatagrams, RepeatedDatagrams
from transports.faults.gige_kinds import IpChange, LinkDown, LostHeartbeat, RefusedResends
from transports.faults.script import FaultPlan
from transports.gige.endpoint import GigeFactory
from transports.gige.host import CameraGone, GigeHost, GigeHostError
from transports.gige.parameters import GigeLink
from transports.link.digest import digest_of
from transports.link.endpoint import LinkBroken
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.ring import FREE_RUNNING, EventRing

pytestmark = pytest.mark.socket

TICK_NS = 500_000
GAP_US = 10


class Bench:
    """A link on a clock that the test moves, and a host that shares the test's thread with it."""

    def __init__(self, faults=(), **more):
        self.clock = FakeClock(1_000_000_000)
        self.ring = EventRing(200_000)
        factory = GigeFactory(GigeLink(**{"port": 0, **more}), FaultPlan("gige", scripted=tuple(faults), seed=1))
        camera = partial(Triton2, GigeSettings(start_delay_us=0))
        self.link = Link(LinkSetup("gige", self.ring, camera, factory), self.clock)
        self.loop = asyncio.new_event_loop()
        self.loop.run_until_complete(self.link.endpoint.start())
        self.host, port = self.link.endpoint.address.split(":")
        self.port = int(port)
        self.events = []

    def connect(self):
        """Take the camera."""
        return _PunctualHost(self.host, self.port, now_ns=self.clock.now_ns)

    def run(self, events, host=None, turns=400):
        """Play events, and let the host read as they come."""
        self.ring.start(FREE_RUNNING)
        for part in np.array_split(events, 50):
            self.ring.push(part)
            self.ring.publish(int(part["t"][-1]))
            self.turn(host)
        self.ring.publish(int(events["t"][-1]) + 5000)
        for _ in range(turns):
            self.turn(host)

    def turn(self, host=None):
        self.clock.advance(TICK_NS)
        self.link.tick()
        if host is not None:
            self.events.append(host.read(0.001))

    def close(self):
        self.loop.run_until_complete(self.link.close())
        self.loop.close()
        return self.link.report(final=True)


class _PunctualHost(GigeHost):
    """A host whose requests have all reached the link when it has read: its clock is faster than the machine's."""

    def read(self, timeout_s):
        events = super().read(timeout_s)
        self.read_register(Register.PRIVILEGE)
        return events


class Refusing:
    """A socket that has no room for every third datagram, or run of datagrams, when it comes for the first time."""

    def __init__(self):
        self.refusals = self._calls = 0

    def take_the_place_of(self, stream):
        self._socket, stream._socket = stream._socket, self

    def __getattr__(self, name):
        return getattr(self._socket, name)

    def sendto(self, data, to):
        self._refuse()
        return self._socket.sendto(data, to)

    def sendmsg(self, *how):
        self._refuse()
        return self._socket.sendmsg(*how)

    def _refuse(self):
        self._calls += 1
        if self._calls % 3 == 0:
            self.refusals += 1
            raise BlockingIOError


@pytest.fixture
def bench():
    made = []

    def make(*faults, **more):
        made.append(Bench(faults, **more))
        return made[-1]

    yield make
    for one in made:
        if not one.loop.is_closed():
            one.close()


def stream(count):
    draw = np.random.default_rng(5)
    events = np.zeros(count, EVENT)
    events["t"] = 1 + np.arange(count) * GAP_US
    events["x"], events["y"] = draw.integers(0, 1280, count), draw.integers(0, 720, count)
    return events


@pytest.mark.parametrize("segmentation", [False, True])
def test_a_host_reads_every_event(bench, segmentation):
    here = bench(segmentation=segmentation)
    host = here.connect()
    assert host.identity.model == "TRT009S-E"
    host.start(packet_size=576)
    events = stream(20_000)
    here.run(events, host)
    assert np.concatenate(here.events).tobytes() == events.tobytes()
    host.close()
    report = here.close()
    assert (report.delivered, report.dropped, report.digest) == (20_000, 0, digest_of(events))


def test_ranges_and_the_rate_control_that_a_host_writes_act(bench):
    """Columns 100 to 299 and rows 50 to 549 alone, in the order of neuromorphic_drivers' source; 3 events in 500 us."""
    here, events = bench(), stream(20_000)
    host = here.connect()
    for address, value in (
        (COLUMNS.on, 1), (COLUMNS.count, 1), (COLUMNS.selector, 0), (COLUMNS.offset, 0), (COLUMNS.size, 200),
        (COLUMNS.offset, 100), (ROWS.on, 1), (ROWS.count, 1), (ROWS.selector, 0), (ROWS.offset, 0), (ROWS.size, 500),
        (ROWS.offset, 50), (Erc.PERIOD_US, 500), (Erc.EVENTS, 3), (Erc.ON, 1),
    ):  # fmt: skip
        host.write(address, value)
    host.start()
    here.run(events, host)
    inside = events[(events["x"] >= 100) & (events["x"] < 300) & (events["y"] >= 50) & (events["y"] < 550)]
    periods = [inside[inside["t"] // 500 == k][:3] for k in range(20_000 * GAP_US // 500 + 1)]
    assert sum(map(len, periods)) < len(inside)
    assert np.concatenate(here.events).tobytes() == np.concatenate(periods).tobytes()
    host.close()


@pytest.mark.parametrize("segmentation", [False, True])
def test_packets_that_find_no_room_leave_later_in_order(bench, segmentation):
    here, refused = bench(segmentation=segmentation), Refusing()
    refused.take_the_place_of(here.link.endpoint._stream)
    host = here.connect()
    host.start(packet_size=576)
    events = stream(20_000)
    here.run(events, host)
    assert refused.refusals > 50
    assert np.concatenate(here.events).tobytes() == events.tobytes()
    host.close()
    assert (here.close().delivered, host.assembly.asked) == (20_000, 0)


@pytest.mark.parametrize("fault", [LostDatagrams, RepeatedDatagrams, LateDatagrams])
def test_faults_of_the_stream_are_healed_for_a_host_that_asks_again(bench, fault):
    here = bench(fault(rate=0.02, count=0, for_s=1000.0))
    host = here.connect()
    host.start(packet_size=576)
    events = stream(20_000)
    here.run(events, host)
    assert here.link.endpoint.faults[0].hits > 3
    assert np.concatenate(here.events).tobytes() == events.tobytes()
    assert (host.assembly.asked > 0) == (fault is LostDatagrams)
    host.close()
    report = here.close()
    assert (report.delivered, report.faults[0].events_lost, report.digest) == (20_000, 0, digest_of(events))


def test_blocks_whose_packets_never_come_are_blamed_on_the_fault(bench):
    here = bench(LostDatagrams(rate=0.004, count=0, for_s=1000.0))
    host = here.connect()
    host.start(packet_size=576)
    host.assembly.missing = lambda now_ns: []
    here.run(stream(20_000))
    lost = here.close().faults[0].events_lost
    host.close()
    assert 0 < lost < 20_000
    assert here.link.report(final=True).delivered == 20_000 - lost


def test_packets_that_the_camera_keeps_no_more_are_not_sent_again(bench):
    here = bench(
        LostDatagrams(rate=0.01, count=0, for_s=1000.0),
        RefusedResends(rate=0.5, count=0, for_s=1000.0),
    )
    host = here.connect()
    host.start(packet_size=576)
    here.run(stream(20_000), host)
    healed, refused = host.assembly.asked, here.link.endpoint.faults[1].hits
    lost = here.close().faults[1].events_lost
    host.close()
    assert 0 < refused < healed
    assert 0 < lost < 20_000
    assert here.link.report(final=True).delivered == 20_000 - lost == sum(map(len, here.events))


def test_a_heartbeat_that_is_lost_takes_control_away(bench):
    here = bench()
    host = here.connect()
    host.start()
    here.link.endpoint.inject(LostHeartbeat())
    while here.link._device.owner is not None:
        here.turn()
    here.clock.advance(2_000_000_000)
    with pytest.raises(CameraGone, match="control was taken away"):
        host.read(0.001)
    assert here.link.endpoint.faults[0].hits == 1
    host.close()
    here.connect().close()


def test_a_link_that_is_down_is_silent_both_ways_and_comes_back(bench):
    here = bench(LinkDown(at_s=0.05, for_s=0.05))
    host = here.connect()
    host.start(packet_size=576)
    events, asked = stream(20_000), socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    asked.settimeout(0.3)
    here.ring.start(FREE_RUNNING)
    here.ring.push(events)
    here.ring.publish(60_000)
    for _ in range(200):
        here.turn()
    asked.sendto(request(Command.DISCOVERY, 1), (here.host, here.port))
    with pytest.raises(TimeoutError):
        asked.recv(1000)
    here.ring.publish(int(events["t"][-1]) + 5000)
    for _ in range(600):
        here.turn()
    asked.settimeout(20.0)
    asked.sendto(request(Command.DISCOVERY, 2), (here.host, here.port))
    assert len(asked.recv(1000)) == 256
    asked.close()
    host.close()
    report = here.close()
    assert 3000 < report.faults[0].events_lost < 8000
    assert report.delivered + report.faults[0].events_lost + report.dropped_in_device == 20_000


def _discovered(where):
    """Return the address that a camera tells when it is asked at `where`; None while nobody answers there."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as asked:
        asked.settimeout(0.3)
        asked.connect(where)
        try:
            asked.send(request(Command.DISCOVERY, 1))
            return socket.inet_ntoa(asked.recv(1000)[8 + 0x24 :][:4])
        except (TimeoutError, ConnectionRefusedError):
            return None


def _turns_until(here, condition):
    """Let the link turn until the processes have come to something; they have a minute for it."""
    end_s = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end_s
        here.turn()


def test_a_camera_that_changes_its_address_is_lost_and_found_at_the_new_one(bench, caplog):
    here = bench(IpChange(at_s=0.05, for_s=0.05, address="127.0.0.77"))
    old = here.connect()
    old.start(packet_size=576)
    events, begun = stream(20_000), (here.host, here.port)
    assert _discovered(begun) == here.host
    _turns_until(here, lambda: here.link._device.owner is not None)
    here.ring.start(FREE_RUNNING)
    here.ring.push(events)
    here.ring.publish(60_000)
    _turns_until(here, lambda: here.link._device.owner is None)
    assert _discovered(begun) is None
    here.ring.publish(150_000)
    _turns_until(here, lambda: here.link.endpoint.address == f"127.0.0.77:{here.port}")
    moved = ("127.0.0.77", here.port)
    _turns_until(here, lambda: _discovered(moved) == "127.0.0.77")
    assert _discovered(begun) is None
    here.clock.advance(2_000_000_000)
    with pytest.raises(CameraGone):
        old.read(0.001)
    old.close()
    assert [one.message for one in caplog.records] == [
        f"ip_change: the camera has left {begun[0]} and is at 127.0.0.77"
    ]
    here.host, here.events = moved[0], []
    new = here.connect()
    assert new.read_register(Register.STREAM_SOURCE_PORT) == here.link.endpoint._stream._socket.getsockname()[1]
    new.start(packet_size=576)
    here.turn(new)
    begins_us = here.link._device.epoch_us
    here.ring.publish(int(events["t"][-1]) + 5000)
    for _ in range(400):
        here.turn(new)
    seen = np.concatenate(here.events)
    expected = events[events["t"] > begins_us]
    assert len(expected) > 4000
    assert np.array_equal(seen["t"] + np.uint64(begins_us), expected["t"])
    new.close()
    report = here.close()
    assert (report.faults[0].hits, report.counts.get("heartbeats missed")) == (1, None)
    assert report.delivered + report.dropped + report.dropped_in_device == 20_000


def test_an_address_that_the_machine_does_not_have_is_told_and_the_camera_comes_back(bench, caplog):
    here = bench(IpChange(at_s=0.0, for_s=0.01, address="192.0.2.1"))
    here.ring.start(FREE_RUNNING)
    here.turn()
    here.ring.publish(20_000)
    _turns_until(here, lambda: caplog.records)
    assert "this machine has no 192.0.2.1" in caplog.records[0].message
    _turns_until(here, lambda: _discovered((here.host, here.port)) == here.host)


def test_an_address_that_another_camera_has_ends_the_link_with_the_reason(bench):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        here = bench(IpChange(at_s=0.0, for_s=0.01, address="127.0.0.78"))
        other.bind(("127.0.0.78", here.port))
        here.ring.start(FREE_RUNNING)
        here.turn()
        here.ring.publish(20_000)
        with pytest.raises(LinkBroken, match=r"cannot listen on 127\.0\.0\.78 port \d+ .*another camera may be there"):
            _turns_until(here, lambda: False)


@pytest.mark.parametrize("segmentation", [False, True])
def test_what_waited_leaves_in_bursts_that_a_stock_socket_buffer_holds(bench, segmentation):
    here = bench(segmentation=segmentation)
    host = here.connect()
    host.start(packet_size=1400)
    here.turn()
    here.ring.start(FREE_RUNNING)
    here.ring.push(stream(150_000))
    here.ring.publish(2_000_000)
    sizes = []
    while sum(sizes) < 400:
        before = here.link.endpoint.sent["packets"]
        here.clock.advance(10_000_000)
        here.link.tick()
        sizes.append(here.link.endpoint.sent["packets"] - before)
    assert max(sizes) * 2304 < 2 * 212_992
    host.close()


def test_a_host_is_told_of_edges_until_it_answers(bench):
    here = bench()
    host = here.connect()
    told = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    told.settimeout(20.0)
    told.bind(("127.0.0.1", 0))
    host.start()
    for register, value in (
        (Register.MESSAGE_ADDRESS, 0x7F000001), (Register.MESSAGE_PORT, told.getsockname()[1]),
        (Register.MESSAGE_TIMEOUT, 10), (Register.MESSAGE_RETRIES, 1000 // 10), (Evs.EVENT_NOTIFICATION, 1),
    ):  # fmt: skip
        host.write(register, value)
    here.turn()
    here.link.happen(EdgeKind.RISING)
    messages = []
    for _ in range(2):
        here.clock.advance(10_000_000)
        here.link.tick()
        data, camera = told.recvfrom(1000)
        messages.append(data)
    assert messages[0] == messages[1]
    assert messages[0][:4] + messages[0][8:12] == bytes.fromhex("420100c000009000")
    told.sendto(struct.pack(">HHHH", 0, 0xC1, 0, 1), camera)
    here.clock.advance(10_000_000)
    here.link.tick()
    told.settimeout(0.2)
    with pytest.raises(TimeoutError):
        told.recv(1000)
    assert (here.link.endpoint.counts["messages"], here.link.endpoint.counts["messages lost"]) == (1, 0)
    told.close()
    host.close()


def test_strangers_get_nothing(bench):
    here = bench(allow=("127.0.0.9",))
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.settimeout(0.2)
    stranger.sendto(request(Command.DISCOVERY, 1), (here.host, here.port))
    with pytest.raises(TimeoutError):
        stranger.recv(1000)
    assert here.close().counts["requests of senders not allowed"] == 1
    stranger.close()


def test_the_stream_goes_to_nobody_who_is_not_allowed(bench):
    here = bench(allow=("127.0.0.1",))
    host = here.connect()
    host.start()
    host.write(Register.STREAM_ADDRESS, 0x7F000009)
    here.run(stream(2000), turns=20)
    report = here.link.report()
    assert (report.delivered, report.dropped) == (0, 2000)
    assert here.link.endpoint.counts["packets that could not be sent"] > 0
    host.close()


def test_a_second_host_is_refused_with_a_reason(bench):
    here = bench()
    first = here.connect()
    with pytest.raises(GigeHostError, match="access denied; another host has control"):
        here.connect()
    first.close()
    here.connect().close()


def test_a_host_notices_that_control_was_taken_away(bench):
    here = bench()
    host = here.connect()
    host.start()
    host.write(Register.PRIVILEGE, 0)
    here.clock.advance(2_000_000_000)
    with pytest.raises(CameraGone, match="control was taken away"):
        host.read(0.001)
    host.close()


def test_a_host_that_finds_no_camera_says_what_to_look_at():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        silent.settimeout(0.0)
        with pytest.raises(CameraGone, match="is its run started"):
            GigeHost("127.0.0.1", silent.getsockname()[1], now_ns=FakeClock(0).now_ns)


def test_a_port_that_is_taken_names_the_cure():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        made = GigeFactory(GigeLink(port=taken.getsockname()[1]))
        clock = FakeClock(0)
        link = Link(LinkSetup("gige", EventRing(10), Triton2, made), clock)
        with pytest.raises(OSError, match=r"an address of its own, such as 127\.0\.0\.2"):
            asyncio.run(link.endpoint.start())


def test_floods_of_requests_do_not_stop_the_stream(bench):
    here = bench()
    host = here.connect()
    host.start()
    draw = np.random.default_rng(1)
    flood = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    events = stream(20_000)
    self_ring = here.ring
    self_ring.start(FREE_RUNNING)
    for part in np.array_split(events, 50):
        for _ in range(40):
            flood.sendto(draw.bytes(int(draw.integers(0, 600))), (here.host, here.port))
            flood.sendto(request(Command.READREG, 7, struct.pack(">I", 0)), (here.host, here.port))
        self_ring.push(part)
        self_ring.publish(int(part["t"][-1]))
        here.turn(host)
    self_ring.publish(int(events["t"][-1]) + 5000)
    for _ in range(200):
        here.turn(host)
    assert np.concatenate(here.events).tobytes() == events.tobytes()
    flood.close()
    host.close()


RIG = """
title = "t"
[scene]
kind = "checkerboard"
[camera]
model = "{model}"
[[links]]
kind = "gige"
{more}
"""


@pytest.mark.parametrize(
    ("model", "more", "told"),
    [
        ("davis346", "", 'a davis346 has no Ethernet plug; use model = "triton2"'),
        ("triton2", 'host = "0.0.0.0"', "give one address of this machine"),
        ("triton2", 'host = "camera"', "must be an IPv4 address"),
        ("triton2", 'host = "10.0.0.1"', "say who may connect"),
        ("triton2", "mbit_s = 0", "mbit_s must be 1 to 100000"),
        ("triton2", "block_us = 0", "block_us must be 1 to 1000000"),
        ("triton2", "port = 70000", "port must be 0"),
        ("triton2", '[[faults]]\nkind = "ip_change"\naddress = "camera"', "address must be an IPv4 address"),
        ("triton2", '[[faults]]\nkind = "ip_change"\naddress = "0.0.0.0"', "address must be an IPv4 address"),
    ],
)
def test_rigs_that_cannot_be_are_refused_with_a_reason(model, more, told):
    with pytest.raises(RigError, match=told):
        parse_rig(RIG.format(model=model, more=more), "t.toml", "t")
