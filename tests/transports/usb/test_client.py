"""The user-space host against servers that stop, lie or vanish: each ends in an error that says whose fault it was."""

import contextlib
import socket
import threading

import pytest

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity, SetupPacket
from firmware_protocol.usb.usbip import DeviceListReply, DeviceRecord, ImportReply, OpStatus, Submitted, Unlinked
from transports.usb.host import DeviceAbsent, DeviceBusy, PeerBroken, PeerGone, TransferTimeout
from transports.usb.usbip.client import UsbipHost

RECORD = DeviceRecord("1-1", 1, 2, Identity(0x152A, 0x841A, 0x0206, Speed.SUPER))
IMPORTED = bytes(ImportReply(OpStatus.OK, RECORD))
GET = SetupPacket(0x80, 6, 0x0100, 0, 18)
OP, URB = 40, 48


@pytest.fixture
def script():
    """Gives start(steps): a socket whose other end reads n bytes and answers, for each (n, answer), then closes."""
    threads, sockets = [], []

    def play(sock, steps):
        # The host may leave in the middle.
        with sock, contextlib.suppress(ConnectionError):
            for n, answer in steps:
                while n > 0 and (part := sock.recv(n)):
                    n -= len(part)
                sock.sendall(answer)

    def start(*steps, hold=False):
        ours, theirs = socket.socketpair()
        # Held open until the host leaves: it sends nothing more.
        waits = [(1 << 20, b"")] if hold else []
        thread = threading.Thread(target=play, args=(theirs, [*steps, *waits]))
        thread.start()
        threads.append(thread)
        sockets.append(ours)
        return ours

    start.threads = threads
    yield start
    for sock in sockets:
        sock.close()
    for thread in threads:
        thread.join(120)


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        (bytes(ImportReply(OpStatus.NO_DEVICE)), DeviceAbsent, "status 4"),
        (bytes(ImportReply(OpStatus.NOT_AVAILABLE)), DeviceAbsent, "status 1"),
        (bytes(ImportReply(OpStatus.BUSY)), DeviceBusy, "another host"),
        (bytes(DeviceListReply(())), PeerBroken, "answered the import"),
        (b"HTTP/1.1 400 Bad Request\r\n", PeerBroken, "version 0x4854"),
        (IMPORTED[:100], PeerGone, "closed"),
        (b"", PeerGone, "closed"),
    ],
)
def test_import_that_fails(script, answer, error, says):
    with pytest.raises(error, match=says):
        UsbipHost(script((OP, answer)), "1-1", timeout_s=120)


def test_import_that_is_not_answered(script):
    with pytest.raises(TransferTimeout, match="import of 1-1"):
        UsbipHost(script(hold=True), "1-1", timeout_s=0.05)


@pytest.mark.parametrize(
    ("answer", "error", "says"),
    [
        (bytes(Submitted(1, 0, 19, bytes(19))), PeerBroken, "longer than the limit of 18"),
        (bytes(Submitted(99, 0, 0)), PeerBroken, "URB 99, which is not pending"),
        (bytes(Submitted(1, -71, 0)), PeerBroken, "URB status -71"),
        (bytes(48), PeerBroken, "unknown URB answer"),
        (bytes(Submitted(1, 0, 18, bytes(18)))[:60], PeerGone, "closed"),
    ],
)
def test_control_answers_that_make_no_sense(script, answer, error, says):
    host = UsbipHost(script((OP, IMPORTED), (URB, answer)), "1-1", timeout_s=120)
    with pytest.raises(error, match=says):
        host.control_in(GET)
    host.close()


def test_control_that_is_not_answered_is_taken_back(script, impatient):
    sock = script((OP, IMPORTED), (URB, b""), (URB, bytes(Unlinked(2, -104))), (URB, bytes(Submitted(3, 0, 1, b"x"))))
    host = UsbipHost(sock, "1-1", timeout_s=120)
    impatient()
    with pytest.raises(TransferTimeout):
        host.control_in(GET)
    assert host.control_in(GET) == b"x"
    host.close()


def test_answer_to_a_urb_that_was_taken_back_is_a_fault(script, impatient):
    late = bytes(Submitted(1, 0, 1, b"x"))
    host = UsbipHost(script((OP, IMPORTED), (2 * URB, bytes(Unlinked(2, -104))), (URB, late)), "1-1", timeout_s=120)
    impatient()
    with pytest.raises(TransferTimeout):
        host.control_in(GET)
    with pytest.raises(PeerBroken, match="URB 1, which is not pending"):
        host.control_in(GET)
    host.close()


def test_stream_that_is_answered_out_of_order(script, impatient):
    sock = script((OP, IMPORTED), (2 * URB, bytes(Submitted(2, 0, 1, b"b"))), hold=True)
    host = UsbipHost(sock, "1-1", timeout_s=120)
    stream = host.stream(2, 100, 2)
    with pytest.raises(PeerBroken, match="URB 2 was answered before URB 1"):
        stream.read(120)
    impatient()  # nobody answers any more
    host.close()


def test_data_that_arrived_are_read_though_the_server_has_gone(script):
    replies = b"".join(bytes(Submitted(n, 0, 1, bytes([n]))) for n in (1, 2, 3))
    host = UsbipHost(script((OP, IMPORTED), (3 * URB, replies)), "1-1", timeout_s=120)
    stream = host.stream(2, 100, 3)
    script.threads[0].join(120)
    assert [stream.read(120) for _ in range(3)] == [b"\1", b"\2", b"\3"]
    with pytest.raises(PeerGone):
        stream.read(120)
    host.close()


def test_close_keeps_what_came_while_urbs_were_taken_back(script):
    late = bytes(Submitted(1, 0, 4, b"late"))
    sock = script((OP, IMPORTED), (2 * URB, b""), (2 * URB, late + bytes(Unlinked(3, 0)) + bytes(Unlinked(4, -104))))
    host = UsbipHost(sock, "1-1", timeout_s=120)
    stream = host.stream(2, 100, 2)
    assert stream.close() == [b"late"]
    assert stream.close() == []
    host.close()


def test_urbs_that_are_not_taken_back_are_a_timeout(script, impatient):
    host = UsbipHost(script((OP, IMPORTED), hold=True), "1-1", timeout_s=120)
    stream = host.stream(2, 100, 2)
    impatient()
    with pytest.raises(TransferTimeout, match="2 URBs"):
        stream.close()
    host.close()


@pytest.mark.socket
def test_no_server_at_the_address():
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = listener.getsockname()[1]
    with pytest.raises(PeerGone, match="is the emulator running"):
        UsbipHost.attach(port=port)
