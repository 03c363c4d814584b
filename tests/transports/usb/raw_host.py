"""A USB/IP host of a few lines, byte by byte."""

import struct
import time

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.usbip import DeviceListRequest, ImportRequest, Submit
from transports.usb.usbip.client import UsbipHost, Wire, connect

GET_DEVICE = SetupPacket(0x80, 0x06, 0x0100, 0, 18)
SET_REGISTER = SetupPacket(0x40, 0xBF, 6, 0, 4)
IMPORT_REPLY_BYTES = 320
HEADER = 48


def list_devices(port):
    """Return the devices that a server on this machine offers."""
    wire = Wire(connect("127.0.0.1", port, 120.0))
    wire.send(bytes(DeviceListRequest()))
    reply = wire.receive(time.monotonic() + 120.0)
    wire.close()
    return reply.devices


def read(sock, n):
    data = b""
    while len(data) < n:
        part = sock.recv(n - len(data))
        if not part:
            raise ConnectionResetError(f"closed after {len(data)} of {n} bytes")
        data += part
    return data


def read_urb(sock):
    """Give (command, seqnum, status) of a reply without data."""
    command, seqnum, _, _, _, status = struct.unpack_from(">IIIIIi", read(sock, HEADER))
    return command, seqnum, status


def is_closed(sock):
    """True when the server ends the connection, whatever it still says before."""
    sock.settimeout(120)
    try:
        while sock.recv(65536):
            pass
    except ConnectionResetError:
        return True
    except TimeoutError:
        return False
    return True


def attached(bench):
    sock = bench.connect()
    sock.sendall(bytes(ImportRequest("1-1")))
    read(sock, IMPORT_REPLY_BYTES)
    return sock


def assert_serves(bench, device):
    """The next host gets the device and an answer."""
    before = device.log.count("detached")
    with UsbipHost(bench.connect(), "1-1", timeout_s=120) as host:
        assert len(host.control_in(GET_DEVICE)) == 18
    device.wait_for("detached", before + 1)


def submit(seqnum=1, **fields):
    urb = {"devid": 0x10002, "is_in": True, "endpoint": 2, "length": 100} | fields
    return bytes(Submit(seqnum, **urb))


def patched(message, offset, value):
    return message[:offset] + struct.pack(">i", value) + message[offset + 4 :]
