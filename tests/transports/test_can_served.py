"""A bus that evstim serves, read by python-can's own socketcand client."""

import asyncio
import threading

import can
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.socketcand import SocketcandSession, frame_line
from transports.can_bus.bus import BusDown
from transports.can_bus.parameters import CanParameters
from transports.can_bus.python_can import PythonCanBus, from_message, to_message
from transports.can_bus.served import ServedBus
from transports.pacing import MonotonicClock


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
    return ServedBus(CanParameters(port=0, bitrate=1_000_000), MonotonicClock())


@pytest.mark.socket
def test_python_can_hears_us_and_we_hear_it():
    ours = [Frame(0x1A2, bytes([i & 255, i >> 8])) for i in range(300)]
    theirs = [Frame(0x522, bytes([i])) for i in range(50)]
    got = []

    def client(port):
        with can.Bus(interface="socketcand", channel="can0", host="127.0.0.1", port=port) as bus:
            for frame in theirs:
                bus.send(to_message(frame))
            while len(got) < len(ours) and (message := bus.recv(5.0)) is not None:
                got.append(from_message(message))

    async def serve():
        bus = served()
        await bus.open()
        assert not bus.heard
        thread = threading.Thread(target=client, args=(int(bus.address.rpartition(":")[2]),))
        thread.start()
        heard, to_send = [], list(ours)
        while not bus.heard:
            await asyncio.sleep(0.001)
        await asyncio.sleep(0.03)  # the client's handshake settles
        while thread.is_alive():
            heard += bus.take()
            while to_send and bus.send(to_send[0]):
                to_send.pop(0)
            await asyncio.sleep(0.0005)
        heard += bus.take()
        await bus.close()
        return heard

    heard = asyncio.run(serve())
    assert got == ours
    assert [h.frame for h in heard] == theirs
    stamps = np.array([h.t_ns for h in heard])
    assert (np.diff(stamps) > 50_000).all()  # no two frames overlap on the wire


@pytest.mark.socket
def test_our_reader_of_python_can_joins_it():
    async def both():
        bus = served()
        await bus.open()
        port = int(bus.address.rpartition(":")[2])
        reader = PythonCanBus(CanParameters(interface="socketcand", port=port), "can0")
        await reader.open()
        await asyncio.sleep(0.03)
        bus.send(Frame(0x080, b"\x07"), urgent=True)
        frames, own = [], []
        while not frames:
            own += bus.take()
            frames += reader.take()
            await asyncio.sleep(0.001)
        await reader.close()
        await bus.close()
        return frames, own

    frames, own = asyncio.run(both())
    assert [h.frame for h in frames] == [Frame(0x080, b"\x07")]
    assert [(h.frame, h.own) for h in own] == [(Frame(0x080, b"\x07"), True)]
    assert abs(frames[0].t_ns - own[0].t_ns) < 50_000_000


@pytest.mark.socket
def test_a_port_that_is_taken_is_named():
    async def twice():
        first = served()
        await first.open()
        port = int(first.address.rpartition(":")[2])
        try:
            await ServedBus(CanParameters(port=port), MonotonicClock()).open()
        finally:
            await first.close()

    with pytest.raises(BusDown, match="give this link another port"):
        asyncio.run(twice())
