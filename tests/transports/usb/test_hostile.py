"""Peers that break the protocol, stop, vanish, or race: each has a defined end, and the server serves the next host."""

from __future__ import annotations

import asyncio
import logging
import socket
import struct

import pytest

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.usbip import DeviceListRequest, ImportRequest, Submit, Unlink
from transports.network.admission import Places
from transports.network.listener import Listener
from transports.usb.host import PeerGone
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.connection import ConnectionSettings
from transports.usb.usbip.server import UsbipServer

pytestmark = pytest.mark.socket

GET_DEVICE = SetupPacket(0x80, 0x06, 0x0100, 0, 18)
SET_REGISTER = SetupPacket(0x40, 0xBF, 6, 0, 4)
IMPORT_REPLY_BYTES = 320
HEADER = 48


def read(sock: socket.socket, n: int) -> bytes:
    data = b""
    while len(data) < n:
        part = sock.recv(n - len(data))
        if not part:
            raise ConnectionResetError(f"closed after {len(data)} of {n} bytes")
        data += part
    return data


def read_urb(sock: socket.socket) -> tuple[int, int, int]:
    """Give (command, seqnum, status) of a reply without data."""
    command, seqnum, _, _, _, status = struct.unpack_from(">IIIIIi", read(sock, HEADER))
    return command, seqnum, status


def is_closed(sock: socket.socket) -> bool:
    """True when the server ends the connection, whatever it still says before."""
    sock.settimeout(30)
    try:
        while sock.recv(65536):
            pass
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


def attached(bench) -> socket.socket:
    sock = bench.connect()
    sock.sendall(bytes(ImportRequest("1-1")))
    read(sock, IMPORT_REPLY_BYTES)
    return sock


def assert_serves(bench, device) -> None:
    """The next host gets the device and an answer."""
    before = device.log.count("detached")
    with UsbipHost(bench.connect(), "1-1", timeout_s=30) as host:
        assert len(host.control_in(GET_DEVICE)) == 18
    device.wait_for("detached", before + 1)


def submit(seqnum: int = 1, **fields) -> bytes:
    urb = {"devid": 0x10002, "is_in": True, "endpoint": 2, "length": 100} | fields
    return bytes(Submit(seqnum, **urb))


def patched(message: bytes, offset: int, value: int) -> bytes:
    return message[:offset] + struct.pack(">i", value) + message[offset + 4 :]


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


def test_peer_that_resets_the_connection_with_urbs_pending(served, device):
    sock = attached(served)
    sock.sendall(b"".join(submit(n) for n in range(1, 33)))
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    sock.close()
    device.wait_for("detached")
    assert_serves(served, device)


def test_urbs_arrive_byte_by_byte(served):
    sock = attached(served)
    for byte in submit(5, endpoint=0, setup=bytes(GET_DEVICE), length=18):
        sock.sendall(bytes([byte]))
    assert read_urb(sock) == (3, 5, 0)
    assert read(sock, 18)[0] == 18


def test_peer_that_stops_reading_leaves_the_data_in_the_device(served, device):
    transfer = 1 << 20
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    host = UsbipHost(sock, "1-1", timeout_s=30)
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
    assert all(stream.read(30) == chunk for chunk in chunks)
    device.wait_for("sent", 32)


def test_data_unsent_when_the_peer_vanishes_are_reported_lost(served, device):
    sock = served.connect()
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 65536)
    host = UsbipHost(sock, "1-1", timeout_s=30)
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
    host = UsbipHost(sock, "1-1", timeout_s=30)
    stream = host.stream(2, 1000, 4000)
    served.feed(device, *[bytes(1000)] * 4000)
    reported = served.call(lambda: len(device.sent_data))
    assert 0 < reported < 4000
    # Nothing but the rest of one answer waits in our own memory: the rest is with the kernel.
    (connection,) = served.server._connections
    assert served.call(connection._transport.get_write_buffer_size) <= 48 + 1000
    closing = asyncio.run_coroutine_threadsafe(served.server.close(linger_s=5), served.loop)
    received: list[bytes | None] = []
    with pytest.raises(PeerGone):
        received.extend(iter(lambda: stream.read(30), None))
    host.close()
    closing.result(30)
    assert len(received) == len(device.sent_data) >= reported
    assert device.lost_data == []


def test_close_copes_with_a_host_that_has_just_reset_its_connection(served, device):
    sock = attached(served)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))

    async def reset_and_close():
        sock.close()  # the loop has had no turn to see it
        await served.server.close(linger_s=5)

    served.run(reset_and_close())
    assert device.log == ["attached", "detached"]


def test_close_does_not_wait_for_a_host_that_does_not_read(served, device):
    host = UsbipHost(served.connect(), "1-1", timeout_s=30)
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
    host = UsbipHost(bench.connect(), "1-1", timeout_s=30)
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
        UsbipHost(bench.connect(), "1-1", timeout_s=30) as lazy,
        UsbipHost(bench.connect(), "1-2", timeout_s=30) as keen,
    ):
        lazy.stream(2, 16 << 20, 1)
        bench.feed(stuck, bytes(16 << 20))
        stream = keen.stream(2, 1000, 4)
        bench.feed(other, b"for the keen one")
        assert stream.read(30) == b"for the keen one"


def test_unlink_of_a_pending_urb_gives_econnreset_and_no_other_answer(served, device):
    sock = attached(served)
    sock.sendall(submit(1) + submit(2) + bytes(Unlink(3, 0x10002, 1)))
    assert read_urb(sock) == (4, 3, -104)
    served.feed(device, b"")
    assert read_urb(sock) == (3, 2, 0)


def test_unlink_of_an_answered_or_unknown_urb_gives_status_0(served, device):
    device.chunks.append(b"")
    sock = attached(served)
    sock.sendall(submit(1))
    assert read_urb(sock) == (3, 1, 0)
    sock.sendall(bytes(Unlink(2, 0x10002, 1)) + bytes(Unlink(3, 0x10002, 999)))
    assert [read_urb(sock) for _ in range(2)] == [(4, 2, 0), (4, 3, 0)]


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
    with UsbipHost(bench.connect(), "1-2", timeout_s=30) as other:
        with UsbipHost(bench.connect(), "1-1", timeout_s=30) as host, pytest.raises(PeerGone):
            host.control_in(SetupPacket(0xC0, 0xEE, 0, 0, 4))
        faulty.wait_for("detached")
        assert len(other.control_in(GET_DEVICE)) == 18
    assert isinstance(bench.faults[0]["exception"], ValueError)


def test_silent_connection_is_closed_in_the_operation_phase_only(bench, device):
    bench.start({"1-1": device}, ConnectionSettings(operation_timeout_s=0.5))
    with UsbipHost(bench.connect(), "1-1", timeout_s=30) as host:
        assert is_closed(bench.connect())
        assert len(host.control_in(GET_DEVICE)) == 18


def test_an_idle_connection_makes_way_and_an_attached_host_does_not(bench, device):
    bench.start({"1-1": device}, places=Places(total=2, per_address=2))
    with UsbipHost(bench.connect(), "1-1", timeout_s=30) as host:
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
    with UsbipHost(bench.connect(), "1-1", timeout_s=30) as host:
        assert is_closed(bench.connect())
        assert len(host.control_in(GET_DEVICE)) == 18
    assert bench.server.counts == {"connections refused: too many": 1}


def test_idle_connections_do_not_lock_the_device_list(served, device):
    idle = [served.connect() for _ in range(100)]
    sock = served.connect()
    sock.settimeout(2)
    sock.sendall(bytes(DeviceListRequest()))
    assert len(read(sock, 12)) == 12
    assert_serves(served, device)
    assert all(sock.fileno() > 0 for sock in idle)


def test_a_peer_that_is_not_allowed_is_refused_and_counted(bench, device):
    bench.start({"1-1": device}, allow=["127.0.0.2", "10.0.0.0/8"])
    assert is_closed(bench.connect())
    assert bench.server.counts == {"connections refused: address not allowed": 1}
    with socket.create_connection(("127.0.0.1", bench.server.port), 30, ("127.0.0.2", 0)) as sock:
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
    host = UsbipHost(bench.connect(), "1-1", timeout_s=30)
    stream = host.stream(2)
    bench.run(bench.server.close(linger_s=0.05))
    assert device.log == ["attached", "detached"]
    with pytest.raises(PeerGone):
        stream.read(30)
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
