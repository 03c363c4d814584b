"""The port of the Precision Time Protocol on the loopback interface, at free ports: stamps, senders, faults."""

import contextlib
import socket
import time

import pytest

from firmware_protocol.ptp.messages import GROUP
from firmware_protocol.ptp.slave import PortState
from tests.firmware_protocol.ptp_network import Master
from tests.free_ports import free_port
from transports.gige import ptp_port
from transports.gige.ptp_port import PtpPort, PtpSockets, ptp_slave

pytestmark = pytest.mark.socket
HOST = "127.0.0.1"
MASTER = Master(log_announce=6)  # no stop of the machine is as long as its intervals
SLACK_NS = 5_000_000  # between two clocks of the machine, one of which is slewed


@pytest.fixture
def ports(monkeypatch):
    found = free_port(), free_port()
    monkeypatch.setattr(ptp_port, "EVENT_PORT", found[0])
    monkeypatch.setattr(ptp_port, "GENERAL_PORT", found[1])
    return found


@pytest.fixture
def opened(ports, at_end):
    return lambda allow=(): at_end.enter_context(contextlib.closing(PtpSockets(HOST, allow)))


@pytest.fixture
def sender():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as made:
        made.setsockopt(socket.IPPROTO_IP, socket.IP_MULTICAST_IF, socket.inet_aton(HOST))
        yield made


@pytest.mark.parametrize("which", [0, 1])
@pytest.mark.parametrize("to", [GROUP, HOST])
def test_a_message_has_the_time_of_its_arrival(opened, ports, sender, which, to):
    sockets = opened()
    before_ns = time.monotonic_ns()
    taken = []
    while not taken:  # the kernel begins to stamp a moment after it was requested to
        sender.sendto(b"some octets", (to, ports[which]))
        taken = list(sockets.take())
    after_ns = time.monotonic_ns()
    data, local_ns = taken[0]
    assert data == b"some octets"
    assert before_ns - SLACK_NS < local_ns < after_ns + SLACK_NS


def test_a_message_sent_has_the_time_at_which_it_left(opened):
    sockets = opened()
    before_ns = time.monotonic_ns()
    sockets.send(b"request")
    left_ns = None
    while left_ns is None:
        left_ns = sockets.sent_ns()
    after_ns = time.monotonic_ns()
    assert sockets.sent_ns() is None
    assert before_ns - SLACK_NS < left_ns < after_ns + SLACK_NS


def test_senders_that_are_not_allowed_are_counted(opened, ports, sender):
    sockets = opened(("10.0.0.1",))
    sender.sendto(b"some octets", (GROUP, ports[0]))
    while not sockets.counts:
        assert list(sockets.take()) == []
    assert sockets.counts == {"ptp messages of senders not allowed": 1}


def test_ports_that_cannot_be_used(ports):
    with pytest.raises(OSError, match=r"UDP ports \d+ and \d+ of 198.51.100.1 for PTP.*ptp = false"):
        PtpSockets("198.51.100.1", ())


def test_a_port_that_fails_is_faulty_and_opened_again(ports, sender, monkeypatch):
    slave = ptp_slave(1, 0)
    slave.enable()
    port = PtpPort(slave, HOST, ())
    assert not port.turn()
    assert slave.state == PortState.LISTENING
    port.move("198.51.100.1")  # no address of this machine
    assert (slave.state, port.descriptors) == (PortState.FAULTY, [])
    assert not port.turn()
    assert slave.state == PortState.FAULTY
    port.move(HOST)
    assert port.turn()
    assert (slave.state, len(port.descriptors)) == (PortState.INITIALIZING, 4)
    port.turn()
    for _ in range(2):
        sender.sendto(MASTER.announce(), (GROUP, ports[1]))
    port.turn(is_mute=True)
    assert slave.state == PortState.LISTENING
    for _ in range(2):
        sender.sendto(MASTER.announce(), (GROUP, ports[1]))
    while slave.state != PortState.UNCALIBRATED:
        port.turn()
    assert slave.counts["ptp masters chosen"] == 1
    port.move(HOST)
