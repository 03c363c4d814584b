"""Clients that stop reading, vanish, talk, or come in thousands; receivers that are not there."""

import contextlib
import os
import socket
import struct
from contextlib import ExitStack, closing

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.run.link_process import LinkFailed
from evstim.testing.link_contract import event_stream
from tests.transports.network_streams.stream_readers import CaerReader, DvReader, udp_port
from tests.transports.opened_links import balanced, opened, wait_until
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING

pytestmark = [pytest.mark.system, pytest.mark.socket]

FLOOD = int(os.environ.get("EVSTIM_FLOOD", "200"))
CAER = 'kind = "tcp"\nformat = "caer"\nport = 0\nbuffer_mib = 0.0625'


def clients(link, count):
    wait_until(link, lambda report: report.state.startswith(f"{count} client"))


def connected(link):
    host, _, port = link.report.address.rpartition(":")
    return socket.create_connection((host, int(port)), timeout=120)


def test_a_client_that_stops_reading_costs_others_nothing():
    """A paced run: the sleeper misses events, the reader has them all."""
    events = event_stream(1_500_000)
    link = opened(CAER)
    with connected(link) as sleeper:
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        with closing(CaerReader(link)) as reader:
            clients(link, 2)
            link.start(MonotonicClock().now_ns())
            link.push(events, 4_500_000)
            received = reader.read(len(events))
            report = link.stop(10.0)
    np.testing.assert_array_equal(received, events)
    assert report.delivered == len(events)
    assert report.counts["events that single clients missed"] > 0
    balanced(report, len(events))


@pytest.mark.long
def test_a_run_that_is_not_paced_does_not_wait_for_ever_for_a_sleeper():
    events = event_stream(1_500_000)
    link = opened(CAER)
    with connected(link) as sleeper, closing(CaerReader(link)) as reader:
        sleeper.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        clients(link, 2)
        link.start(FREE_RUNNING)
        link.push(events, 4_500_000)
        received = reader.read(len(events))
        report = link.stop(10.0)
    np.testing.assert_array_equal(received, events)
    balanced(report, len(events))


def test_a_client_that_vanishes_takes_only_what_was_on_its_way():
    events = event_stream(1_000_000)  # 8 MB: more than the kernel holds for a client that does not read
    link = opened(CAER)
    gone = connected(link)
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 8192)
    clients(link, 1)
    link.start(FREE_RUNNING)
    link.push(events, 3_000_000)
    taken = 0
    while taken < 10_000:
        taken += len(gone.recv(4096))
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    gone.close()  # a reset
    wait_until(link, lambda report: "waiting" in report.state)
    report = link.stop(1.0)
    balanced(report, len(events))
    assert report.camera.lost_on_link > 0
    assert report.camera.flushed + report.camera.not_running > 0


def test_events_without_a_client_are_counted_and_a_later_client_gets_later_ones():
    early, late = event_stream(1000), event_stream(2000, 1_000_000)
    link = opened('kind = "tcp"\nport = 0')
    link.start(FREE_RUNNING)
    link.push_all(early, 500_000)
    wait_until(link, lambda report: report.camera is not None and report.camera.not_running == 1000)
    with closing(DvReader(link)) as reader:
        link.push_all(late, 2_000_000)
        received = reader.read(len(late))
        report = link.stop(5.0)
    np.testing.assert_array_equal(received, late)
    assert (report.delivered, report.camera.not_running) == (2000, 1000)


@pytest.mark.parametrize("form", ["dv", "caer", "event_image", "display"])
def test_garbage_is_ignored_and_much_of_it_ends_the_connection(form):
    link = opened(f'kind = "tcp"\nformat = "{form}"\nport = 0')
    with connected(link) as asking, connected(link) as flooding:
        clients(link, 2)
        asking.sendall(b"GET / HTTP/1.1\r\n\r\n" + os.urandom(1000))
        with contextlib.suppress(ConnectionError):
            for _ in range(64):
                flooding.sendall(os.urandom(1 << 16))
        clients(link, 1)
        link.start(FREE_RUNNING)
        link.push_all(event_stream(20_000), 60_000)
        report = link.stop(10.0)
    assert report.counts["clients closed: sent data"] == 1
    balanced(report, 20_000)
    assert report.delivered == 20_000


def test_a_flood_of_connections_leaves_a_client_alone():
    """Two hundred by default; `EVSTIM_FLOOD=10000` takes some seventy seconds."""
    events = event_stream(20_000)
    link = opened('kind = "tcp"\nport = 0')
    with closing(DvReader(link)) as reader, ExitStack() as held:
        for number in range(FLOOD):
            link.listen()  # or the pipe of its reports fills
            peer = connected(link)
            if number % (FLOOD // 25):
                peer.close()
            else:
                held.enter_context(peer)
        wait_until(link, lambda report: sum(report.counts.values()) > FLOOD // 2)
        link.start(FREE_RUNNING)
        link.push_all(events, 60_000)
        received = reader.read(len(events))
        report = link.stop(10.0)
    np.testing.assert_array_equal(received, events)
    balanced(report, len(events))


def test_an_address_that_is_not_allowed_gets_nothing():
    link = opened('kind = "tcp"\nport = 0\nallow = ["192.0.2.1"]')
    with connected(link) as stranger:
        assert stranger.recv(100) == b""
    wait_until(link, lambda report: report.counts.get("connections refused: address not allowed") == 1)
    link.stop(0.0)


def test_a_port_that_is_taken_says_what_to_do():
    with socket.create_server(("127.0.0.1", 0)) as other, pytest.raises(LinkFailed, match="another port"):
        opened(f'kind = "tcp"\nport = {other.getsockname()[1]}')


def test_datagrams_that_nobody_takes_are_told():
    with closing(udp_port()) as receiver:
        port = receiver.getsockname()[1]
    link = opened(f'kind = "udp"\nport = {port}')
    link.start(FREE_RUNNING)
    link.push_all(event_stream(20_000), 60_000)
    report = link.stop(10.0)
    assert report.counts["datagrams refused: no program listens"] > 0
    balanced(report, 20_000)


def test_a_rate_that_is_too_low_ends_with_a_ledger_that_balances():
    with closing(udp_port()) as receiver:
        link = opened(f'kind = "udp"\nport = {receiver.getsockname()[1]}\nmbit_s = 0.1')
        link.start(FREE_RUNNING)
        link.push_all(event_stream(20_000), 60_000)
        report = link.stop(0.2)
    balanced(report, 20_000)
    assert 0 < report.delivered < 20_000


@pytest.mark.parametrize(("table", "message"), [
    ('kind = "tcp"\nhost = "0.0.0.0"', "allow"),
    ('kind = "tcp"\nbuffer_mib = 0.0', "buffer_mib must be"),
    ('kind = "tcp"\nframe_ms = 0.0', "frame_ms must be"),
    ('kind = "udp"\nhost = "192.0.2.7"', "elsewhere = true"),
    ('kind = "udp"\nport = 0', "port must be"),
    ('kind = "udp"\nmbit_s = 0.0', "mbit_s must be"),
    ('kind = "udp"\nhost = ""', "host is empty"),
])  # fmt: skip
def test_a_table_that_cannot_be_is_refused(table, message):
    with pytest.raises(RigError, match=message):
        parse_rig(f'[scene]\nkind = "checkerboard"\n[[links]]\n{table}\n', "a.toml", "a")
