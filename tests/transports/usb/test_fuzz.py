"""Any bytes at all: the server keeps its books, lets go of the device, and serves the next host."""

import asyncio
import socket

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from firmware_protocol.usb.usbip import DeviceListRequest, ImportRequest, Submit, Unlink
from transports.usb.usbip.server import UsbipServer

small = st.integers(0, 20)
u32 = st.integers(0, 0xFFFFFFFF)
submits = st.builds(
    Submit,
    seqnum=small,
    devid=u32,
    is_in=st.booleans(),
    endpoint=st.integers(0, 4),
    length=small,
    setup=st.binary(min_size=8, max_size=8),
    data=st.binary(max_size=20),
    flags=u32,
    interval=small,
)
unlinks = st.builds(Unlink, seqnum=small, devid=u32, victim=small)
pieces = st.one_of(submits.map(bytes), unlinks.map(bytes), st.binary(max_size=60), st.just(bytes(ImportRequest("1-1"))))


async def play(device, pieces):
    """Send the pieces one after the other to a new server, vanish, and ask it for its devices."""
    server = UsbipServer({"1-1": device})
    loop = asyncio.get_running_loop()
    # A device model that breaks on fuzzed requests ends its connection; that is not what is tested here.
    loop.set_exception_handler(lambda loop, context: None)
    ours, theirs = socket.socketpair()
    with ours:
        await server.serve(theirs)
        ours.setblocking(False)
        for piece in pieces:
            try:
                await loop.sock_sendall(ours, piece)
            except OSError:
                break
            await asyncio.sleep(0)
            server.pump()
    after, theirs = socket.socketpair()
    with after:
        await server.serve(theirs)
        after.setblocking(False)
        await loop.sock_sendall(after, bytes(DeviceListRequest()))
        listed = await asyncio.wait_for(loop.sock_recv(after, 4096), 120)
    await server.close(linger_s=0)
    return listed


@pytest.mark.socket
@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(imports=st.booleans(), pieces=st.lists(pieces, max_size=12), stock=st.lists(st.binary(max_size=30), max_size=5))
def test_server_survives_any_bytes(new_device, imports, pieces, stock):
    device = new_device()
    device.chunks.extend(stock)
    listed = asyncio.run(play(device, [bytes(ImportRequest("1-1"))] * imports + pieces))
    assert listed[:12] == b"\x01\x11\x00\x05" + bytes(7) + b"\x01"
    assert device.log.count("attached") == device.log.count("detached") <= 1
    assert device.given == device.sent_data + device.lost_data
