"""A served bus at the end of a run, and with clients that idle, flood, do not read, or may not connect."""

import asyncio
import socket
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.made_events import events_at
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.can_bus.node import listen_can, peer_of
from transports.can_bus.served import ServedBus
from transports.link.endpoint import LinkFactory
from transports.link.pacing import FakeClock, MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import FREE_RUNNING, EventRing

pytestmark = pytest.mark.socket
PARAMETERS = CanLink(port=0)
HANDSHAKE = b"< open can0 >< rawmode >"


def events(n):
    return events_at(np.arange(n) * 10, x=np.arange(n) % 346)


def port_of(bus):
    return int(bus.address.rpartition(":")[2])


def serving(work, parameters=PARAMETERS, clock=None):
    """Open a bus, let `work(bus)` go on beside its ticks, close it, and return what came of the work."""

    async def serve():
        bus = ServedBus(parameters, clock or MonotonicClock())
        await bus.open()
        task = asyncio.create_task(work(bus))
        while not task.done():
            bus.take()
            await asyncio.sleep(0.0005)
        await bus.close()
        return await task

    return asyncio.run(asyncio.wait_for(serve(), 300))


@pytest.fixture
def sockets():
    opened = []
    yield opened
    for sock in opened:
        sock.close()


async def connect(bus, sockets, source="127.0.0.1"):
    sock = socket.socket()
    sockets.append(sock)
    sock.bind((source, 0))
    sock.setblocking(False)
    await asyncio.get_running_loop().sock_connect(sock, ("127.0.0.1", port_of(bus)))
    return sock


async def read(sock, least=1 << 30):
    """Read so many bytes, or to the end."""
    data = b""
    try:
        while len(data) < least and (more := await asyncio.get_running_loop().sock_recv(sock, 65536)):
            data += more
    except ConnectionError:
        pass
    return data


async def joined(bus, sockets):
    sock = await connect(bus, sockets)
    sock.send(HANDSHAKE)
    while not bus.has_listeners:
        await asyncio.sleep(0.001)
    await read(sock, len(b"< hi >< ok >< ok >"))
    return sock


@pytest.mark.system
@pytest.mark.parametrize("carriage", ["raw", "isotp", "cfp"])
@pytest.mark.parametrize("bitrate", [1_000_000, 125_000])
async def test_at_the_end_of_a_run_what_counts_as_delivered_has_been_received(carriage, bitrate):
    """The link is closed while it is in full swing, without a drain by its process."""
    parameters = CanLink(port=0, carriage=carriage, bitrate=bitrate, share=1.0, answer_ms=60_000)
    n = 1000
    device = partial(Instrument, (346, 260), InstrumentSettings(queue_ms=60_000))
    ring, clock = EventRing(n), MonotonicClock()
    link = Link(LinkSetup("can", ring, device, LinkFactory(CanEndpoint, parameters)), clock)
    await link.endpoint.start()
    there = replace(peer_of(parameters), port=int(link.endpoint.report().address.rpartition(":")[2]))
    told = None
    listening = asyncio.create_task(
        listen_can(there, lambda now: told is None or (now.events < told.delivered and clock.now_ns() < end_ns), clock)
    )
    while not link.endpoint.report().use.carried:
        link.tick()
        await asyncio.sleep(0.001)
    ring.start(FREE_RUNNING)
    ring.push(events(n))
    ring.publish(10**7)
    while link.report().delivered < 200:
        link.tick()
        await asyncio.sleep(0.0005)
    await link.close()
    end_ns = clock.now_ns() + 120 * 10**9  # what came is there already
    told = link.report(final=True)
    heard = await listening
    assert told.delivered == heard.events
    assert told.delivered + told.dropped + told.camera.flushed == n
    assert heard.digest == told.digest


@pytest.mark.system
def test_more_connections_than_select_could_take_leave_a_listener_every_frame(sockets):
    async def flood(bus):
        listener = await joined(bus, sockets)
        for _ in range(70):
            newcomers = [await connect(bus, sockets) for _ in range(20)]
            while not bus.send(Frame(0x1A2, bytes(8))):
                await asyncio.sleep(0.001)
            for sock in newcomers[::2]:
                sock.close()  # the others stay
        got = b""
        while got.count(b"< frame 1A2 ") < 70:
            got += await read(listener, 1)
        return len(bus._members), dict(bus.counts), bus.missed

    members, counts, missed = serving(flood)
    assert members <= 16
    assert missed == 0
    assert counts["idle connections closed for newer ones"] >= 70 * 10 - 16


def test_settled_clients_in_all_places_are_kept_and_a_newcomer_is_told(sockets):
    async def full(bus):
        members = [await joined(bus, sockets) for _ in range(16)]
        told = await read(await connect(bus, sockets))
        members[0].send(b"< echo >")
        return told, await read(members[0], 8), bus.counts

    told, echo, counts = serving(full)
    assert told == b"< error too many clients >"
    assert echo == b"< echo >"
    assert counts == {"connections refused: too many": 1}


def test_a_client_that_asks_and_does_not_read_is_sent_off_and_counted():
    async def deaf(bus):
        loop = asyncio.get_running_loop()
        with socket.create_connection(("127.0.0.1", port_of(bus))) as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.setblocking(False)
            while not bus._members:
                await asyncio.sleep(0.001)
            await asyncio.sleep(0)
            most, sent = 0, 0
            try:
                while sent < 64 << 20:
                    await asyncio.wait_for(loop.sock_sendall(sock, b"<>" * 8192), 120)
                    sent += 16_384
                    unsent = [member.client._transport.get_write_buffer_size() for member in bus._members.values()]
                    most = max([most, *unsent])
            except ConnectionError:
                pass
        return most, bus.counts

    most, counts = serving(deaf)
    assert most < (1 << 20) + 65_536
    assert counts == {"slow clients disconnected": 1}


@pytest.mark.system
def test_a_client_that_does_not_read_misses_frames_and_the_bus_closes(monkeypatch):
    monkeypatch.setattr("transports.can_bus.served._CLOSE_TURNS", 50)
    monkeypatch.setattr("transports.can_bus.served._MOST_UNSENT_BYTES", 4096)
    clock = FakeClock(10**9)
    seen = []

    async def deaf(bus):
        seen.append(bus)
        with socket.socket() as sock:
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
            sock.connect(("127.0.0.1", port_of(bus)))
            sock.setblocking(False)
            sock.send(HANDSHAKE)
            while not bus.has_listeners:
                clock.advance(10**6)
                await asyncio.sleep(0.001)
            sent = 0
            while bus.missed < 100:
                sent += bus.send(Frame(0x1A2, bytes(8)))
                clock.advance(150_000)
                await asyncio.sleep(0)
            (member,) = bus._members.values()
            buffered = member.client.unsent_lines
            missed = bus.missed
            await bus.close()
            return buffered, missed, bus.missed

    buffered, missed, after = serving(deaf, clock=clock)
    assert buffered > 50
    assert after >= missed + buffered  # what was in our memory never was written


def test_a_client_that_sends_more_than_the_bus_carries_has_to_wait(sockets):
    async def talk(bus):
        sock = await joined(bus, sockets)
        frames = 3000
        sending = asyncio.create_task(asyncio.get_running_loop().sock_sendall(sock, b"< send 522 1 5 >" * frames))
        most = 0
        while bus._wire.busy_ns < frames * 50_000:
            most = max(most, *(bus._wire.waiting(node) for node in bus._members))
            await asyncio.sleep(0.001)
        await sending
        return most

    assert 48 <= serving(talk) < 48 + 4096 // 16 + 1


def test_a_peer_outside_the_list_is_refused_and_counted(sockets):
    async def strangers(bus):
        stranger, friend = await connect(bus, sockets), await connect(bus, sockets, "127.0.0.9")
        return await read(stranger), await read(friend, 6), bus.counts

    over, hello, counts = serving(strangers, CanLink(port=0, allow=("127.0.0.8/30",)))
    assert over == b""
    assert hello == b"< hi >"
    assert counts == {"connections refused: address not allowed": 1}


async def test_answers_that_find_no_room_are_bounded_and_counted():
    """Others ask for a flow control with every frame while the bus never has room for it."""
    clock = FakeClock(10**9)
    ring = EventRing(100)
    device = partial(Instrument, (346, 260), InstrumentSettings())
    parameters = CanLink(port=0, carriage="isotp")
    link = Link(LinkSetup("can", ring, device, LinkFactory(CanEndpoint, parameters)), clock)
    endpoint = link.endpoint
    first = Frame(parameters.isotp.receive, bytes([0x10, 20, 1, 2, 3, 4, 5, 6]))
    for _ in range(2000):
        endpoint._receive(0, first, clock.now_ns())
    waiting, counts = len(endpoint._urgent), dict(endpoint.report().counts)
    assert waiting == 1024
    assert counts["answers dropped, the bus had no room"] == 2000 - 1024
