"""Hosts that race, linger or crowd the server: each has a defined end, and the server serves the next one."""

from __future__ import annotations

import asyncio
import logging
import socket

import pytest

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.usbip import DeviceListRequest, Unlink
from tests.transports.usb.raw_host import (
    GET_DEVICE,
    SET_REGISTER,
    assert_serves,
    attached,
    is_closed,
    read,
    read_urb,
    submit,
)
from transports.connections import Listener, Places
from transports.usb.host import PeerGone
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.connection import ConnectionSettings
from transports.usb.usbip.server import UsbipServer

pytestmark = pytest.mark.socket


def test_unlink_of_a_pending_urb_gives_econnreset_and_no_other_answer(served, device):
    sock = attached(served)
    sock.sendall(submit(1) + submit(2) + bytes(Unlink(3, 0x10002, 1)))
    assert read_urb(sock) == (4, 3, -104)
    served.feed(device, b"")
    assert read_urb(sock) == (3, 2, 0)


def test_unlink_of_an_answered_or_unknown_urb_gives_status_0(served, device):
    device.chunks.append(b"")
    sock = attached(served)
    sock.sendall(submit(5))
    assert read_urb(sock) == (3, 5, 0)
    sock.sendall(bytes(Unlink(6, 0x10002, 5)) + bytes(Unlink(7, 0x10002, 4)))
    assert [read_urb(sock) for _ in range(2)] == [(4, 6, 0), (4, 7, 0)]


def test_an_unlink_that_overtook_its_urb_takes_it_back_when_it_comes(served, device):
    """As Linux's vhci_hcd sends them now and then: see `early_unlinks`."""
    sock = attached(served)
    sock.sendall(submit(1) + bytes(Unlink(4, 0x10002, 2)) + submit(2) + submit(3))
    assert read_urb(sock) == (4, 4, -104)
    for _ in range(2):
        served.feed(device, b"")
    assert [read_urb(sock) for _ in range(2)] == [(3, 1, 0), (3, 3, 0)]


def test_an_out_urb_that_was_taken_back_before_it_came_is_not_done(served, device):
    sock = attached(served)
    write = submit(2, is_in=False, endpoint=0, length=4, setup=bytes(SET_REGISTER), data=b"abcd")
    sock.sendall(bytes(Unlink(3, 0x10002, 2)) + write)
    assert read_urb(sock) == (4, 3, -104)
    assert device.register == bytes(4)


def test_unlink_races_give_each_urb_one_end(served, device):
    """Whatever wins, a URB is either taken back or answered before its unlink is, and no data are lost."""
    device.chunks.extend([b""] * 100)
    sock = attached(served)
    for n in range(1, 401, 2):
        sock.sendall(submit(n))
        sock.sendall(bytes(Unlink(n + 1, 0x10002, n)))
    ends: dict[int, list[tuple[int, int]]] = {n: [] for n in range(1, 401, 2)}
    while sum(end[-1:] in ([(4, -104)], [(4, 0)]) for end in ends.values()) < len(ends):
        command, seqnum, status = read_urb(sock)
        ends[seqnum - (command == 4)].append((command, status))
    assert all(end in ([(4, -104)], [(3, 0), (4, 0)]) for end in ends.values())
    answered = [end for end in ends.values() if end[0][0] == 3]
    device.wait_for("sent", len(answered))
    assert len(answered) == served.call(lambda: len(device.given)) == len(device.sent_data)


def test_fault_in_the_device_model_ends_its_connection_only(bench, new_device):
    faulty, sound = new_device(), new_device()
    bench.start({"1-1": faulty, "1-2": sound})
    with UsbipHost(bench.connect(), "1-2", timeout_s=120) as other:
        with UsbipHost(bench.connect(), "1-1", timeout_s=120) as host, pytest.raises(PeerGone):
            host.control_in(SetupPacket(0xC0, 0xEE, 0, 0, 4))
        faulty.wait_for("detached")
        assert len(other.control_in(GET_DEVICE)) == 18
    assert isinstance(bench.faults[0]["exception"], ValueError)


def test_silent_connection_is_closed_in_the_operation_phase_only(bench, device):
    bench.start({"1-1": device}, ConnectionSettings(operation_timeout_s=0.5))
    with UsbipHost(bench.connect(), "1-1", timeout_s=120) as host:
        assert is_closed(bench.connect())
        assert len(host.control_in(GET_DEVICE)) == 18


def test_an_idle_connection_makes_way_and_an_attached_host_does_not(bench, device):
    bench.start({"1-1": device}, places=Places(total=2, per_address=2))
    with UsbipHost(bench.connect(), "1-1", timeout_s=120) as host:
        idle = bench.connect()
        idle.sendall(b"\x01")
        newer = bench.connect()
        assert is_closed(idle)
        newer.sendall(bytes(DeviceListRequest()))
        assert len(read(newer, 12)) == 12
        assert len(host.control_in(GET_DEVICE)) == 18
    assert bench.server.counts == {"idle connections closed for newer ones": 1}


def test_attached_hosts_in_all_places_let_nobody_in(bench, device):
    bench.start({"1-1": device}, places=Places(total=1))
    with UsbipHost(bench.connect(), "1-1", timeout_s=120) as host:
        assert is_closed(bench.connect())
        assert len(host.control_in(GET_DEVICE)) == 18
    assert bench.server.counts == {"connections refused: too many": 1}


def test_idle_connections_do_not_lock_the_device_list(served, device):
    idle = [served.connect() for _ in range(100)]
    sock = served.connect()
    sock.settimeout(120)
    sock.sendall(bytes(DeviceListRequest()))
    assert len(read(sock, 12)) == 12
    assert_serves(served, device)
    assert all(sock.fileno() > 0 for sock in idle)


def test_a_peer_that_is_not_allowed_is_refused_and_counted(bench, device):
    bench.start({"1-1": device}, allow=["127.0.0.2", "10.0.0.0/8"])
    assert is_closed(bench.connect())
    assert bench.server.counts == {"connections refused: address not allowed": 1}
    with socket.create_connection(("127.0.0.1", bench.server.port), 120, ("127.0.0.2", 0)) as sock:
        sock.sendall(bytes(DeviceListRequest()))
        assert len(read(sock, 12)) == 12


def test_direction_that_contradicts_the_setup_packet_stalls(served):
    sock = attached(served)
    sock.sendall(submit(1, endpoint=0, is_in=False, length=4, setup=bytes(GET_DEVICE), data=bytes(4)))
    assert read_urb(sock) == (3, 1, -32)


def test_out_urb_to_a_bulk_endpoint_stalls(served):
    sock = attached(served)
    sock.sendall(submit(1, is_in=False, length=4, data=bytes(4)))
    assert read_urb(sock) == (3, 1, -32)


def test_close_detaches_every_host(bench, device):
    bench.start({"1-1": device})
    host = UsbipHost(bench.connect(), "1-1", timeout_s=120)
    stream = host.stream(2)
    bench.run(bench.server.close(linger_s=0.05))
    assert device.log == ["attached", "detached"]
    with pytest.raises(PeerGone):
        stream.read(120)
    host.close()


def test_bus_id_that_no_bus_has_is_refused(device):
    with pytest.raises(ValueError, match="1-1"):
        UsbipServer({"camera": device})


@pytest.mark.parametrize(("address", "warned"), [("127.0.0.1", False), ("0.0.0.0", True)])
def test_warns_when_bound_to_more_than_this_machine(device, caplog, address, warned, monkeypatch):
    monkeypatch.setattr(Listener, "open", lambda self, host, port: None)  # the test opens nothing to the outside
    with caplog.at_level(logging.WARNING):
        asyncio.run(UsbipServer({"1-1": device}, allow=["10.0.0.5"]).start(address))
    assert ("without authentication" in caplog.text) is warned
