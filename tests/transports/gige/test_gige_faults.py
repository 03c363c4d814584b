"""Faults of a GigE Vision camera on its sockets: packets that are healed or blamed, control, link and address lost."""

import socket
import time

import numpy as np
import pytest

from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, ACQUISITION_STOP
from tests.transports.gige.bench import stream
from transports.faults.datagrams import LateDatagrams, LostDatagrams, RepeatedDatagrams
from transports.gige.host import CameraGone
from transports.gige.packet_faults import IpChange, LinkDown, LostHeartbeat, RefusedResends
from transports.link.deliveries import digest_of
from transports.link.endpoint import LinkBroken
from transports.link.rings import FREE_RUNNING

pytestmark = pytest.mark.socket


@pytest.mark.system
@pytest.mark.parametrize("fault", [LostDatagrams, RepeatedDatagrams, LateDatagrams])
def test_faults_of_the_stream_are_healed_for_a_host_that_asks_again(bench, fault):
    here = bench(fault(rate=0.02, count=0, for_s=1000.0))
    host = here.connect()
    host.start(packet_size=576)
    events = stream(20_000)
    here.run(events, host)
    assert here.link.endpoint.faulty.records[0].hits > 3
    assert np.concatenate(here.events).tobytes() == events.tobytes()
    assert (host.assembly.requested > 0) == (fault is LostDatagrams)
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


def test_blocks_that_wait_for_an_earlier_one_keep_the_clock_of_their_own_acquisition(bench):
    here = bench(LostDatagrams(rate=1.0, count=0, for_s=0.005))
    host = here.connect()
    host.start(packet_size=576)
    host.assembly.missing = lambda now_ns: []
    events = stream(20_000)
    here.run(events, turns=0)
    for register in (ACQUISITION_STOP, ACQUISITION_START):
        host.write(register, 1)
    for _ in range(600):
        here.turn()
    host.close()
    report = here.close()
    lost = report.faults[0].events_lost
    assert 0 < lost < 20_000
    assert here.link._device.epoch_us > 0
    assert report.digest == digest_of(events[lost : lost + report.delivered])


def test_packets_that_the_camera_keeps_no_more_are_not_sent_again(bench):
    here = bench(LostDatagrams(rate=0.01, count=0, for_s=1000.0), RefusedResends(rate=0.5, count=0, for_s=1000.0))
    host = here.connect()
    host.start(packet_size=576)
    here.run(stream(20_000), host)
    healed, refused = host.assembly.requested, here.link.endpoint.faulty.records[1].hits
    lost = here.close().faults[1].events_lost
    host.close()
    assert 0 < refused < healed
    assert 0 < lost < 20_000
    assert here.link.report(final=True).delivered == 20_000 - lost == sum(map(len, here.events))


def test_a_heartbeat_that_is_lost_takes_control_away(bench):
    here = bench()
    command = here.link.report().attach_command
    assert command == f"evstim listen gige 127.0.0.1:{here.port}"
    host = here.connect()
    host.start()
    here.turn()
    assert here.link.report().attach_command == ""
    here.link.endpoint.faulty.inject(LostHeartbeat())
    while here.link._device.owner is not None:
        here.turn()
    assert here.link.report().attach_command == command
    here.clock.advance(2_000_000_000)
    with pytest.raises(CameraGone, match="control was taken away"):
        host.read(0.001)
    assert here.link.endpoint.faulty.records[0].hits == 1
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
    asked.settimeout(120.0)
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
    """Let the link turn until the processes have come to something; they have two minutes for it."""
    end_s = time.monotonic() + 120.0
    while not condition():
        assert time.monotonic() < end_s
        here.turn()


def test_a_camera_that_changes_its_address_is_lost_and_found_at_the_new_one(bench, caplog):
    here = bench(IpChange(at_s=0.05, for_s=0.05, address="127.0.0.77"))
    old = here.connect()
    old.start(packet_size=576)
    events, begun = stream(20_000), (here.host, here.port)
    _turns_until(here, lambda: _discovered(begun) == here.host)
    _turns_until(here, lambda: here.link._device.owner is not None)
    here.ring.start(FREE_RUNNING)
    here.ring.push(events)
    here.ring.publish(60_000)
    _turns_until(here, lambda: here.link._device.owner is None)
    assert _discovered(begun) is None
    here.ring.publish(150_000)
    _turns_until(here, lambda: here.link.endpoint.report().address == f"127.0.0.77:{here.port}")
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
