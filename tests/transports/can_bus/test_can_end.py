"""The end of a bus: what was told before it arrives, whatever the listener was saying meanwhile."""

import asyncio
import socket

import pytest

from firmware_protocol.can_frames.canopen import NodeState
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.transport import IsoTpSender
from transports.can_bus.bus import BusDown, PythonCanBus, TimedFrame
from transports.can_bus.kind import CanLink
from transports.can_bus.node import _Listener, peer_of
from transports.can_bus.served import ServedBus
from transports.link.pacing import FakeClock, MonotonicClock

PARAMETERS = CanLink(port=0)
FRAMES = 2000


class DeadWire:
    """A bus of python-can that takes no frame any more."""

    def send(self, message):
        raise OSError(32, "Broken pipe")

    def shutdown(self):
        pass


def test_a_farewell_behind_a_frame_that_asks_for_an_answer_is_heard_though_the_bus_has_gone():
    sender = IsoTpSender(PARAMETERS.isotp)
    sender.start(bytes(100))
    farewell = Frame(PARAMETERS.identifiers.heartbeat, bytes([NodeState.STOPPED]))
    bus = PythonCanBus(peer_of(PARAMETERS), "can0")
    bus._bus = DeadWire()
    bus._unread.extend([TimedFrame(sender.next_frame(0), 1), TimedFrame(farewell, 2)])
    listening = _Listener(PARAMETERS, FakeClock(10**9), None)
    listening.take(bus)
    assert listening.finish(gone=True).ended
    bus._unread.append(TimedFrame(Frame(0x1A2), 3))  # the reader still finds something
    assert [heard.frame for heard in bus.take()] == [Frame(0x1A2)]


def test_a_frame_that_cannot_be_sent_says_so():
    bus = PythonCanBus(peer_of(PARAMETERS), "can0")
    bus._bus = DeadWire()
    with pytest.raises(BusDown, match="Broken pipe"):
        bus.send(Frame(0x1A2))


@pytest.mark.socket
async def test_a_client_that_talks_while_the_bus_ends_gets_every_frame():
    bus, loop = ServedBus(PARAMETERS, MonotonicClock()), asyncio.get_running_loop()
    await bus.open()
    with socket.socket() as sock:
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)  # so that much is still with the server
        sock.setblocking(False)
        await loop.sock_connect(sock, ("127.0.0.1", int(bus.address.rpartition(":")[2])))
        sock.send(b"< open can0 >< rawmode >")
        while not bus.has_listeners:
            await asyncio.sleep(0.001)
        told = 0
        while told < FRAMES:
            told += bus.send(Frame(0x1A2, told.to_bytes(2)))
            bus.take()
            await asyncio.sleep(0)
        while bus.waiting:
            bus.take()
            await asyncio.sleep(0.001)
        sock.send(b"< echo >" * 100)
        closing = asyncio.create_task(bus.close())
        got = b""
        while more := await loop.sock_recv(sock, 65_536):
            got += more
        sock.close()
        await closing
        missed = bus.missed
    assert missed == 0
    assert got.count(b"< frame 1A2 ") == FRAMES
