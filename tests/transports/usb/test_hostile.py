"""Peers that break the protocol, stop, vanish, or race: each has a defined end, and the server serves the next host."""

import asyncio
import socket
import struct

import pytest

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.usbip import DeviceListRequest, ImportRequest
from tests.transports.usb.raw_host import (
    GET_DEVICE,
    IMPORT_REPLY_BYTES,
    SET_REGISTER,
    assert_serves,
    attached,
    is_closed,
    patched,
    read,
    read_urb,
    submit,
)
from transports.usb.host import PeerGone
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.connection import ConnectionSettings

pytestmark = pytest.mark.socket


BROKEN_OPERATIONS = {
    "wrong version": b"\x01\x06\x80\x05" + bytes(4),
    "unknown operation": b"\x01\x11\x80\x99" + bytes(4),
    "text": b"GET / HTTP/1.1\r\n\r\n",
}
BROKEN_URBS = {
    "unknown command": struct.pack(">I", 9) + bytes(44),
    "zeros": bytes(48),
    "import twice": bytes(ImportRequest("1-1")) + bytes(8),
    "negative length": patched(submit(), 24, -1),
    "absurd length": patched(submit(), 24, 0x7FFFFFFF),
    "absurd OUT length": submit(is_in=False, length=0x7FFFFFFF),
    "direction 2": patched(submit(), 12, 2),
    "endpoint 16": submit(endpoint=16),
    "isochronous": patched(submit(), 32, 8),
    "one number twice": submit(7) + submit(7),
}


@pytest.mark.parametrize("data", BROKEN_OPERATIONS.values(), ids=BROKEN_OPERATIONS.keys())
def test_broken_operation_closes_the_connection(served, device, data):
    sock = served.connect()
    sock.sendall(data)
    assert is_closed(sock)
    assert_serves(served, device)


@pytest.mark.parametrize("data", BROKEN_URBS.values(), ids=BROKEN_URBS.keys())
def test_broken_urb_closes_the_connection_and_frees_the_device(served, device, data, caplog):
    sock = attached(served)
    sock.sendall(data)
    assert is_closed(sock)
    device.wait_for("detached")
    assert "broke the protocol" in caplog.text
    assert_serves(served, device)


def test_too_many_pending_urbs_close_the_connection(bench, device):
    bench.start({"1-1": device}, ConnectionSettings(pending_urbs=8))
    sock = attached(bench)
    sock.sendall(b"".join(submit(n) for n in range(1, 9)))
    sock.sendall(submit(100, endpoint=0, setup=bytes(GET_DEVICE), length=18))
    assert read_urb(sock) == (3, 100, 0)
    read(sock, 18)
    sock.sendall(submit(9))
    assert is_closed(sock)
    device.wait_for("detached")


@pytest.mark.parametrize("cut", [1, 20, 47, 49, 51])
def test_peer_that_vanishes_in_the_middle_of_a_urb(served, device, cut):
    message = submit(is_in=False, endpoint=0, length=4, setup=bytes(SET_REGISTER), data=b"\1\2\3\4")
    sock = attached(served)
    sock.sendall(message[:cut])
    sock.close()
    device.wait_for("detached")
    assert device.register == bytes(4)
    assert_serves(served, device)


def test_peer_that_stops_reading_leaves_the_data_in_the_device(served, device):
    transfer = 1 << 20
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    host = UsbipHost(sock, "1-1", timeout_s=120)
    stream = host.stream(2, transfer, 32)
    chunks = [bytes([n]) * transfer for n in range(32)]
    served.feed(device, *chunks)
    taken = served.call(lambda: len(device.given))
    assert taken < 20
    # At most one transfer is under way; all before it are with the kernel.
    assert served.call(lambda: len(device.sent_data)) in (taken - 1, taken)
    served.call(served.server.pump)
    assert served.call(lambda: len(device.given)) == taken
    # It reads again: everything comes, in order.
    assert all(stream.read(120) == chunk for chunk in chunks)
    device.wait_for("sent", 32)


def test_data_unsent_when_the_peer_vanishes_are_reported_lost(served, device):
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    host = UsbipHost(sock, "1-1", timeout_s=120)
    host.stream(2, 16 << 20, 4)
    served.feed(device, bytes(16 << 20), b"second")
    assert served.call(lambda: (len(device.given), len(device.sent_data))) == (1, 0)
    sock.close()
    device.wait_for("detached")
    assert (len(device.lost_data), len(device.sent_data)) == (1, 0)
    assert device.log == ["attached", "lost", "detached"]
    assert list(device.chunks) == [b"second"]


def test_what_is_reported_sent_arrives_even_when_the_server_hangs_up(served, device):
    """The peer has more URBs on their way while the server closes, and reads only then."""
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    host = UsbipHost(sock, "1-1", timeout_s=120)
    stream = host.stream(2, 1000, 4000)
    served.feed(device, *[bytes(1000)] * 4000)
    reported = served.call(lambda: len(device.sent_data))
    assert 0 < reported < 4000
    # Nothing but the rest of one answer waits in our own memory: the rest is with the kernel.
    (connection,) = served.server._connections
    assert served.call(connection._transport.get_write_buffer_size) <= 48 + 1000
    closing = asyncio.run_coroutine_threadsafe(served.server.close(linger_s=120), served.loop)
    received = []
    with pytest.raises(PeerGone):
        received.extend(iter(lambda: stream.read(120), None))
    host.close()
    closing.result(120)
    assert len(received) == len(device.sent_data) >= reported
    assert device.lost_data == []


def test_close_copes_with_a_host_that_has_just_reset_its_connection(served, device):
    sock = attached(served)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    async def reset_and_close():
        sock.close()  # the loop has had no turn to see it
        await served.server.close(linger_s=120)

    served.run(reset_and_close())
    assert device.log == ["attached", "detached"]


def test_close_does_not_wait_for_a_host_that_does_not_read(served, device):
    host = UsbipHost(served.connect(), "1-1", timeout_s=120)
    host.stream(2, 16 << 20, 1)
    served.feed(device, bytes(16 << 20))
    served.run(served.server.close(linger_s=0.05))
    assert device.log == ["attached", "lost", "detached"]


def test_long_answers_wait_until_the_peer_reads(served, device):
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    sock.sendall(bytes(ImportRequest("1-1")))
    read(sock, IMPORT_REPLY_BYTES)
    long = bytes(SetupPacket(0x80, 0x0B, 0, 0, 60_000))
    sock.sendall(b"".join(submit(n, endpoint=0, length=60_000, setup=long) for n in range(300)))
    device.wait_for("long answer")
    assert served.call(lambda: device.log.count("long answer")) < 100
    for n in range(300):
        assert read_urb(sock) == (3, n, 0)
        read(sock, 60_000)
    sock.sendall(submit(300, endpoint=0, length=18, setup=bytes(GET_DEVICE)))
    assert read_urb(sock) == (3, 300, 0)


@pytest.mark.parametrize("request_", [DeviceListRequest(), ImportRequest("9-9")])
def test_a_connection_without_a_device_ends_with_its_answer(served, request_):
    sock = served.connect()
    sock.sendall(bytes(request_))
    assert len(read(sock, 8)) == 8
    assert is_closed(sock)


def test_peer_that_stops_reading_for_good_is_dropped(bench, device):
    bench.start({"1-1": device}, ConnectionSettings(silence_timeout_s=0.3))
    host = UsbipHost(bench.connect(), "1-1", timeout_s=120)
    host.stream(2, 16 << 20, 1)
    bench.feed(device, bytes(16 << 20))
    device.wait_for("detached")
    assert device.log == ["attached", "lost", "detached"]
    assert_serves(bench, device)


def test_peer_that_only_asks_and_never_reads_is_not_listened_to(served, device):
    sock = attached(served)
    sock.settimeout(0.5)
    question = submit(1, endpoint=0, setup=bytes(GET_DEVICE), length=18)
    flood = b"".join(patched(question, 4, n) for n in range(1, 5000))
    with pytest.raises(TimeoutError):
        sock.sendall(flood * 150)
    sock.close()
    device.wait_for("detached")
    assert_serves(served, device)


def test_one_host_that_stops_reading_does_not_hold_up_another(bench, new_device):
    stuck, other = new_device(), new_device()
    bench.start({"1-1": stuck, "1-2": other})
    with (
        UsbipHost(bench.connect(), "1-1", timeout_s=120) as lazy,
        UsbipHost(bench.connect(), "1-2", timeout_s=120) as keen,
    ):
        lazy.stream(2, 16 << 20, 1)
        bench.feed(stuck, bytes(16 << 20))
        stream = keen.stream(2, 1000, 4)
        bench.feed(other, b"for the keen one")
        assert stream.read(120) == b"for the keen one"
