"""The files of FunctionFS, with sockets and pipes in their place: what is read, written, waited for and interrupted."""

import os
import signal
import socket
import threading

import pytest

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.functionfs import Event, EventKind
from transports.usb.functionfs.files import WAKE_SIGNAL, ControlFile, EndpointFile

SETUP = Event(EventKind.SETUP, SetupPacket(0xC0, 0xBF, 6, 1, 4))


@pytest.fixture(autouse=True)
def handler():
    before = signal.signal(WAKE_SIGNAL, lambda *_: None)
    yield
    signal.signal(WAKE_SIGNAL, before)


@pytest.fixture
def ep0():
    """Endpoint 0, and the kernel's end of it."""
    ours, kernel = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    ours.setblocking(False)
    control = ControlFile(ours.detach())
    yield control, kernel
    control.close()
    kernel.close()


def test_events_are_waited_for_and_read_one_by_one(ep0):
    control, kernel = ep0
    for event in (Event(EventKind.BIND), SETUP):
        kernel.send(bytes(event))
    assert control.next_event() == Event(EventKind.BIND)
    assert control.next_event() == SETUP
    read = []
    waiting = threading.Thread(target=lambda: read.append(control.next_event()))
    waiting.start()
    kernel.send(bytes(Event(EventKind.ENABLE)))
    waiting.join(120)
    assert read == [Event(EventKind.ENABLE)]


def test_the_waiting_for_events_can_be_ended(ep0):
    control, _ = ep0
    read = []
    waiting = threading.Thread(target=lambda: read.append(control.next_event()))
    waiting.start()
    control.wake()
    waiting.join(120)
    assert read == [None]


def test_data_stages_go_both_ways(ep0):
    control, kernel = ep0
    control.send(b"\0\0\0\x12")
    assert kernel.recv(16) == b"\0\0\0\x12"
    kernel.send(b"data")
    assert control.receive(4) == b"data"


def test_a_blocked_write_ends_with_a_signal_and_is_not_begun_again():
    reader, writer = os.pipe()
    pipe = EndpointFile(writer, 0x82)
    pipe.write(bytes(65536))  # all that it holds
    ended = threading.Event()
    errors = []

    def write():
        try:
            pipe.write(b"more")
        except InterruptedError as error:
            errors.append(error)
        ended.set()

    thread = threading.Thread(target=write)
    thread.start()
    while not ended.wait(0.01):
        pipe.interrupt()
    thread.join(120)
    assert errors
    pipe.interrupt()  # nobody is in a call: nothing happens
    pipe.close()
    os.close(reader)


def test_an_endpoint_knows_its_number_and_direction():
    reader, writer = os.pipe()
    to_host, from_host = EndpointFile(writer, 0x82), EndpointFile(reader, 0x02)
    assert (to_host.number, to_host.is_in) == (2, True)
    assert (from_host.number, from_host.is_in) == (2, False)
    to_host.write(b"words")
    assert from_host.read(16) == b"words"
    to_host.close()
    from_host.close()
