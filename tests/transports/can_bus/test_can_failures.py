"""A bus whose driver is full, fails or goes off, or that cannot be had: what the link does, and what it says."""

import asyncio
import errno
import itertools
import time
from types import SimpleNamespace

import can
import pytest

from firmware_protocol.can_frames.frame import Frame
from transports.can_bus.bus import BusDown, PythonCanBus, from_message, to_message
from transports.can_bus.kind import CanLink
from transports.link.pacing import wall_less_monotonic_ns

CHANNELS = itertools.count()


def parameters(**more):
    return CanLink(**{"interface": "virtual", "channel": f"test-{next(CHANNELS)}", "share": 1.0} | more)


@pytest.mark.parametrize(
    ("more", "cure"),
    [
        ({"interface": "socketcan", "channel": "can0"}, r"modprobe|ip link set can0 up"),
        ({"interface": "slcan", "channel": "/dev/ttyNOPE"}, "plugged in"),
        ({"interface": "gs_usb", "options": {"index": 0}}, r"python-can\[gs-usb\]"),
        ({"interface": "nonsense"}, "socketcan, .*served"),
    ],
)
def test_a_bus_that_cannot_be_had_names_the_cure(more, cure):
    p = CanLink(**more)
    with pytest.raises(BusDown, match=cure):
        asyncio.run(PythonCanBus(p, p.channel).open())


def test_messages_of_python_can_come_back():
    for frame in (Frame(0x123, b"ab"), Frame(0x12345678, extended=True), Frame(1, bytes(12), fd=True, brs=True)):
        assert from_message(to_message(frame)) == frame
    assert from_message(can.Message(is_remote_frame=True)) is None


@pytest.mark.parametrize(
    ("wrong", "why"),
    [
        ({"channel_b": "can1"}, "one bus"),
        ({"fd": True}, "classic frames only"),
        ({"interface": "socketcan", "fd": True, "carriage": "cfp"}, "classic frames only"),
        ({"share": 0}, "share"),
        ({"node": 0}, "node"),
        ({"bitrate": 2_000_000}, "bitrate"),
        ({"channel": ""}, "channel"),
        ({"heartbeat_ms": -1}, "heartbeat_ms"),
        ({"csp_peer": 0x3FFF}, "csp_peer"),
    ],
)
def test_parameters_say_what_is_wrong(wrong, why):
    with pytest.raises(ValueError, match=why):
        CanLink(**wrong)


def with_virtual_bus(work, **more):
    """Open a bus and a peer's, let `work(bus, peer)` run, and close both."""
    p = parameters(**more)

    async def opened():
        bus, peer = PythonCanBus(p, p.channel), can.Bus(interface="virtual", channel=p.channel)
        try:
            await bus.open()
            return await work(bus, peer)
        finally:
            await bus.close()
            peer.shutdown()

    return asyncio.run(opened())


@pytest.mark.parametrize("full", [("No buffer space available", errno.ENOBUFS), ("Transmit buffer full", None)])
def test_a_full_driver_is_no_fault(monkeypatch, full):
    async def work(bus, _):
        def send(message):
            raise can.CanOperationError(*full)

        monkeypatch.setattr(bus._bus, "send", send)
        return bus.send(Frame(1))

    assert with_virtual_bus(work) is False


@pytest.mark.parametrize(
    ("error", "cure"),
    [
        (
            can.CanOperationError("Failed to transmit", errno.ENETDOWN),
            r"it is down: sudo ip link set test-\d+ up type can",
        ),
        (can.CanOperationError("Failed to transmit", errno.ENXIO), "tries again every second"),
        (OSError(errno.EIO, "Input/output error"), "documentation of python-can"),
    ],
)
def test_a_bus_that_fails_names_the_cure(monkeypatch, error, cure):
    async def work(bus, _):
        def send(message):
            raise error

        monkeypatch.setattr(bus._bus, "send", send)
        with pytest.raises(BusDown, match=cure):
            bus.send(Frame(1))
        with pytest.raises(BusDown, match=cure):
            bus.take()

    with_virtual_bus(work)


def test_bus_off_is_told_with_what_brings_it_back():
    async def work(bus, peer):
        peer.send(to_message(Frame(0x04, bytes(8), error=True)))
        peer.send(to_message(Frame(0x40, bytes(8), error=True)))
        seen = []
        while True:
            seen += bus.take()
            await asyncio.sleep(0.001)

    with pytest.raises(BusDown, match=r"bus-off.*restart-ms 100"):
        with_virtual_bus(work)


class LateBus:
    """A bus of python-can with one frame that has waited for half a minute, by its time stamp."""

    def __init__(self):
        self.frames = [can.Message(time.time() - 30, 0x80, is_extended_id=False)]

    def recv(self, timeout):
        return self.frames.pop() if self.frames else None

    def shutdown(self):
        pass


@pytest.mark.parametrize(("interface", "age_s"), [("socketcan", 30), ("slcan", 0)])
async def test_the_kernels_time_of_a_frame_is_used_however_late_it_is_read(monkeypatch, interface, age_s):
    monkeypatch.setattr(PythonCanBus, "_open", lambda bus: LateBus())
    bus, begun_ns, frames = PythonCanBus(CanLink(interface, "can7"), "can7"), time.monotonic_ns(), []
    await bus.open()
    while not frames:
        await bus.wait(60)
        frames = bus.take()
    await bus.close()
    t_ns, ended_ns = frames[0].t_ns, time.monotonic_ns()
    assert begun_ns <= t_ns + age_s * 1_000_000_000 + 1000 <= ended_ns + 2000


def test_a_process_that_is_stopped_between_two_clocks_does_not_take_their_difference_from_then(monkeypatch):
    now_ns, stops_ns = 0, iter([700_000, 0, 0, 0, 0, 900_000, 0, 0])  # after each reading of a clock

    def read(offset_ns):
        nonlocal now_ns
        seen_ns = now_ns + offset_ns
        now_ns += 100 + next(stops_ns, 0)
        return seen_ns

    clocks = SimpleNamespace(monotonic_ns=lambda: read(0), time_ns=lambda: read(10**18))
    monkeypatch.setattr("transports.link.pacing.time", clocks)
    assert abs(wall_less_monotonic_ns() - 10**18) <= 100
