"""Floods of connections on every port that a run listens on, beside a client that misses nothing.

Two hundred connections by default; `EVSTIM_FLOOD=10000` for the figures of docs/robustness.md. Each connection is
opened, says nothing or half a word, and stays open until the flooder has 200 of them.
"""

import asyncio
import contextlib
import itertools
import os
import socket
import threading

import pytest

from emulator.run.control import ControlSocket, send_request
from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.usb.usbip import DeviceListRequest
from transports.can_bus.kind import CanLink
from transports.can_bus.served import ServedBus
from transports.link.pacing import MonotonicClock
from transports.usb.usbip.server import UsbipServer

pytestmark = pytest.mark.socket
FLOOD = int(os.environ.get("EVSTIM_FLOOD", "200"))
KEPT = 200
HALF_WORDS = [b"", b"\x01", b"< open ca", b'{"request": ']


class Flood:
    """Connections from a thread; `connect` makes one. `done` counts them."""

    def __init__(self, connect):
        self._connect = connect
        self._thread = threading.Thread(target=self._run)
        self._stop = threading.Event()
        self.done = 0

    def __enter__(self):
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()

    @property
    def over(self):
        return not self._thread.is_alive()

    def _run(self):
        with contextlib.ExitStack() as kept:
            for word in itertools.islice(itertools.cycle(HALF_WORDS), FLOOD):
                if self._stop.is_set():
                    return
                sock = kept.enter_context(self._connected())
                with contextlib.suppress(OSError):
                    sock.send(word)
                self.done += 1
                if self.done % KEPT == 0:
                    kept.close()

    def _connected(self):
        while True:
            try:
                return self._connect()
            except BlockingIOError:  # a local socket whose queue is full
                self._stop.wait(0.001)


def read(sock, size):
    data = b""
    while len(data) < size:
        more = sock.recv(size - len(data))
        assert more, f"closed after {data!r}"
        data += more
    return data


async def test_a_served_bus_and_its_listener():
    """Frames go on during the flood; the listener, which joined before, gets each of them in order."""
    got = []

    def listen(sock):
        data = b""
        while b"< frame 7FF " not in data:
            more = sock.recv(65536)
            assert more
            data += more
        got.extend(int(part.split()[1], 16) for part in data.split(b"< frame 1A2")[1:])

    bus = ServedBus(CanLink(port=0), MonotonicClock())
    await bus.open()
    port = int(bus.address.rpartition(":")[2])
    with socket.create_connection(("127.0.0.1", port), 60) as sock:
        sock.sendall(b"< open can0 >< rawmode >")
        while not bus.has_listeners:
            await asyncio.sleep(0.001)
        listener = threading.Thread(target=listen, args=(sock,))
        listener.start()
        sent = 0
        with Flood(lambda: socket.create_connection(("127.0.0.1", port), 60)) as flood:
            while not flood.over:
                bus.take()
                while bus.send(Frame(0x1A2, sent.to_bytes(4, "big"))):
                    sent += 1
                await asyncio.sleep(0.0005)
        while not bus.send(Frame(0x7FF)):
            await asyncio.sleep(0.001)
            bus.take()
        while listener.is_alive():
            bus.take()
            await asyncio.sleep(0.001)
    await bus.close()
    missed, done = bus.missed, flood.done
    assert done == FLOOD
    assert missed == 0
    assert got == list(range(sent))


async def test_the_device_list_of_a_usbip_server():
    answered = []
    server = UsbipServer({})
    await server.start("127.0.0.1", 0)
    port = server.port

    def ask_again():
        with socket.create_connection(("127.0.0.1", port), 60) as sock:
            sock.sendall(bytes(DeviceListRequest()))
            answered.append(read(sock, 12))

    with Flood(lambda: socket.create_connection(("127.0.0.1", port), 60)) as flood:
        while not (flood.over and answered):
            await asyncio.to_thread(ask_again)
    await server.close(linger_s=0)
    done, counts = flood.done, server.counts
    assert done == FLOOD
    assert set(answered) == {bytes.fromhex("011100050000000000000000")}
    assert counts["idle connections closed for newer ones"] > 0


def test_the_control_socket(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    with ControlSocket("bench") as control:

        def connect():
            sock = socket.socket(socket.AF_UNIX)
            sock.setblocking(False)
            try:
                sock.connect(str(control.path))
            except OSError:
                sock.close()
                raise
            return sock

        answers = []

        def keep_asking(flood):
            while not (flood.over and answers):
                answers.append(send_request(control.path, {"n": len(answers)})["n"])

        with Flood(connect) as flood:
            asking = threading.Thread(target=keep_asking, args=(flood,))
            asking.start()
            while asking.is_alive():
                control.poll(lambda message: message)
                asking.join(0.001)
        assert flood.done == FLOOD
        assert answers == list(range(len(answers)))
        assert len(control._clients) <= 16
