"""A bus that evstim serves, read by python-can's own socketcand client."""

import asyncio
import socket
import struct
import threading
from dataclasses import replace
from functools import partial

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import SocketcandSession, frame_line
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.made_events import events_at
from transports.can_bus.bus import BusDown, PythonCanBus, from_message, to_message
from transports.can_bus.endpoint import CanEndpoint
from transports.can_bus.kind import CanLink
from transports.can_bus.node import listen_can, peer_of
from transports.can_bus.served import ServedBus
from transports.link.endpoint import LinkFactory
from transports.link.pacing import MonotonicClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import EventRing
from transports.recording.record import Recorder, load_record


def test_the_handshake_and_a_frame_each_way():
    session = SocketcandSession("can0")
    assert session.push(b"< open ca") == (b"", [])
    assert session.push(b"n0 >< rawmode >") == (b"< ok >< ok >", [])
    assert session.raw
    assert session.push(b"< send 123 2 1 ff >< send 00000123 0 >") == (
        b"",
        [Frame(0x123, b"\x01\xff"), Frame(0x123, extended=True)],
    )
    assert frame_line(Frame(0x123, b"\x1a\x22"), 23_424_242) == b"< frame 123 23.424242 1A22 >"


def test_what_a_client_should_not_say():
    assert SocketcandSession("can0").push(b"< rawmode >")[0] == b"< error unknown command >"
    session = SocketcandSession("can0")
    assert session.push(b"< open can1 >")[0].startswith(b"< error")
    assert session.refused
    session = SocketcandSession("can0")
    session.push(b"< open can0 >")
    said = session.push(b"< send 123 2 1 >< send zzz 0 >< send 800 0 >< echo >")
    assert said == (b"< error syntax >" * 3 + b"< echo >", [])


@given(st.lists(st.binary(max_size=50) | st.sampled_from([b"< open can0 >", b"< send 123 1 5 >", b"<", b">"])))
def test_foreign_bytes_hurt_nobody(pieces):
    session = SocketcandSession("can0")
    for piece in pieces:
        _, frames = session.push(piece)
        assert all(len(frame.data) <= 8 for frame in frames)


def served():
    return ServedBus(CanLink(port=0, bitrate=1_000_000), MonotonicClock())


@pytest.mark.socket
async def test_python_can_hears_us_and_we_hear_it():
    ours = [Frame(0x1A2, bytes([i & 255, i >> 8])) for i in range(300)]
    theirs = [Frame(0x522, bytes([i])) for i in range(50)]
    got = []

    def client(port):
        with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus:
            for frame in theirs:
                bus.send(to_message(frame))
            while len(got) < len(ours) and (message := bus.recv(120.0)) is not None:
                got.append(from_message(message))

    bus = served()
    await bus.open()
    assert not bus.has_listeners
    thread = threading.Thread(target=client, args=(int(bus.address.rpartition(":")[2]),))
    thread.start()
    heard, to_send = [], list(ours)
    while not bus.has_listeners:
        await asyncio.sleep(0.001)
    while thread.is_alive():
        heard += bus.take()
        while to_send and bus.send(to_send[0]):
            to_send.pop(0)
        await asyncio.sleep(0.0005)
    heard += bus.take()
    await bus.close()
    assert got == ours
    assert [h.frame for h in heard] == theirs
    stamps = np.array([h.t_ns for h in heard])
    assert (np.diff(stamps) > 50_000).all()  # no two frames overlap on the wire


@pytest.mark.socket
def test_a_port_that_is_taken_is_named():
    async def twice():
        first = served()
        await first.open()
        port = int(first.address.rpartition(":")[2])
        try:
            await ServedBus(CanLink(port=port), MonotonicClock()).open()
        finally:
            await first.close()

    with pytest.raises(BusDown, match="give this link another port"):
        asyncio.run(twice())


@pytest.mark.socket
@pytest.mark.parametrize("carriage", ["raw", "isotp", "cfp"])
async def test_a_listener_gets_the_events_that_the_link_delivers(tmp_path, carriage):
    rng = np.random.default_rng(2)
    events = events_at(
        np.cumsum(rng.exponential(200, 400)).astype(np.uint64), x=rng.integers(0, 346, 400), y=rng.integers(0, 260, 400)
    )
    parameters = CanLink(port=0, carriage=carriage, answer_ms=60_000)  # a busy machine answers late
    device = partial(Instrument, (346, 260), InstrumentSettings(queue_ms=60_000))
    ring, clock = EventRing(1000), MonotonicClock()
    link = Link(LinkSetup("can", ring, device, LinkFactory(CanEndpoint, parameters)), clock)
    await link.endpoint.start()
    there = replace(peer_of(parameters), port=int(link.endpoint.report().address.rpartition(":")[2]))
    recorder = Recorder(tmp_path / "got.npz")
    listening = asyncio.create_task(listen_can(there, lambda now: now.events < 400, clock, recorder))
    while not (link.endpoint.report().use.carried or listening.done()):  # until the listener is there
        link.tick()
        await asyncio.sleep(0.001)
    ring.start(clock.now_ns())
    ring.push(events)
    ring.publish(10**7)
    while not listening.done():
        link.tick()
        await asyncio.sleep(0.0005)
    await link.close()
    recorder.close()
    heard, told = listening.result(), link.report(final=True)
    assert heard.digest == told.digest
    assert (heard.events, heard.faults, heard.gone) == (400, 0, False)
    assert heard.jitter_us.max > 0
    got, _ = load_record(tmp_path / "got.npz")
    assert np.array_equal(np.sort(got, order=["t", "y", "x"]), np.sort(events, order=["t", "y", "x"]))


@pytest.mark.socket
def test_a_bus_that_nobody_serves_is_told_at_once():
    with pytest.raises(BusDown, match=r"nothing serves a bus on 127\.0\.0\.1 port 1:"):
        asyncio.run(listen_can(CanLink(interface="socketcand", port=1), lambda _: True, MonotonicClock()))


@pytest.mark.socket
def test_a_reset_connection_is_one_line_without_a_traceback(caplog):
    opened = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:

        def serve_and_reset():
            server.accept()[0].close()  # the attempt that finds the port
            connection = server.accept()[0]
            connection.sendall(b"< hi >")
            for _ in range(2):
                connection.recv(100)
                connection.sendall(b"< ok >")
            opened.wait(60)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
            connection.close()

        async def until_lost():
            bus = PythonCanBus(CanLink(interface="socketcand", port=server.getsockname()[1]), "can0")
            await bus.open()
            opened.set()
            try:
                while True:
                    bus.take()
                    await bus.wait(0.1)
            finally:
                await bus.close()

        serving = threading.Thread(target=serve_and_reset)
        serving.start()
        with pytest.raises(BusDown) as lost:
            asyncio.run(until_lost())
        serving.join()
    assert "reset by peer" in str(lost.value)
    assert "Traceback" not in str(lost.value)
    assert not caplog.records
