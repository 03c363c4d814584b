"""A GigE Vision camera on its sockets, and its host: who may come, what they get, what ends it."""

import asyncio
import socket
import struct

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from firmware_protocol.events import EdgeKind
from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2 import Triton2
from firmware_protocol.imx636.triton2_registers import Evs
from tests.transports.gige.bench import Refusing, stream
from transports.gige.endpoint import GigeEndpoint
from transports.gige.host import CameraGone, GigeHost, GigeHostError
from transports.gige.kind import GigeLink
from transports.link.deliveries import digest_of
from transports.link.endpoint import LinkFactory
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

pytestmark = pytest.mark.socket


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
    assert (here.close().delivered, host.assembly.requested) == (20_000, 0)


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
    told.settimeout(120.0)
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
    counts = here.link.endpoint.report().counts
    assert (counts["messages"], counts["messages lost"]) == (1, 0)
    told.close()
    host.close()


def test_strangers_get_nothing(bench):
    here = bench(allow=("127.0.0.9",))
    stranger = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    stranger.settimeout(0.2)
    stranger.sendto(request(Command.DISCOVERY, 1), (here.host, here.port))
    with pytest.raises(TimeoutError):
        stranger.recv(1000)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as friend:  # its request is read after the stranger's
        friend.bind(("127.0.0.9", 0))
        friend.settimeout(120.0)
        friend.sendto(request(Command.DISCOVERY, 1), (here.host, here.port))
        assert len(friend.recv(1000)) == 256
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
    assert here.link.endpoint.report().counts["packets that could not be sent"] > 0
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


def test_a_host_that_finds_no_camera_says_what_to_look_at(monkeypatch):
    monkeypatch.setattr("transports.gige.host._ATTEMPTS", 2)
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as silent:
        silent.bind(("127.0.0.1", 0))
        silent.settimeout(0.0)
        with pytest.raises(CameraGone, match="is its run started"):
            GigeHost("127.0.0.1", silent.getsockname()[1], now_ns=FakeClock(0).now_ns)


def test_a_port_that_is_taken_names_the_cure():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        made = LinkFactory(GigeEndpoint, GigeLink(port=taken.getsockname()[1]))
        clock = FakeClock(0)
        link = Link(LinkSetup("gige", EventRing(10), Triton2, made), clock)
        with pytest.raises(OSError, match=r"an address of its own, such as 127\.0\.0\.2"):
            asyncio.run(link.endpoint.start())


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
        ("triton2", 'host = "10.0.0.1"', "set allow, for example"),
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
