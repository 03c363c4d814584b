"""Hostile datagrams at a GigE Vision camera: it goes on, its stream is exact, and no answer is longer than it may be.

EVSTIM_HOSTILE_DATAGRAMS=1e6 python -m pytest tests/hostile/test_gige.py
"""

import contextlib
import dataclasses
import os
import socket
import struct
from pathlib import Path

import numpy as np
import pytest

from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkProcess
from firmware_protocol.gige.control import DeviceTime
from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2 import Triton2
from firmware_protocol.imx636.triton2_control import Triton2Control
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, Triton2Settings
from tests.hostile.gige_datagrams import answer_limit, hostile_datagram, valid_request
from tests.made_events import steady
from transports.gige.answering import ControlSetup
from transports.gige.endpoint import ControlProcess
from transports.gige.host import GigeHost
from transports.link.pacing import MonotonicClock
from transports.link.rings import FREE_RUNNING, EventRing

COUNT = int(float(os.environ.get("EVSTIM_HOSTILE_DATAGRAMS", "8000")))
PARTS = 50
OWNER = ("127.0.0.1", 40_000)
MOST_GROWTH_KB = 4096
HEARTBEAT_OFF = 1  # a busy machine may let more than the heartbeat's time pass, and a stranger then takes control

RIG = """
title = "t"
[scene]
kind = "checkerboard"
[camera]
model = "triton2"
start_delay_ms = 0.0
[[links]]
kind = "gige"
port = 0
"""


class Strangers:
    """Some sockets that send to a port and look at what comes back."""

    def __init__(self, port, count=4):
        self._sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
        for number, one in enumerate(self._sockets):
            one.bind((f"127.0.0.{1 + number}", 0))
            one.connect(("127.0.0.1", port))
            one.setblocking(False)
        self._limits = [{} for _ in self._sockets]
        self.octets_in = self.octets_out = self.sent = self.answers = 0

    def fire(self, draw, datagram):
        """Send a datagram from one of them."""
        which = int(draw.integers(0, len(self._sockets)))
        if len(datagram) >= 8:
            limits, number = self._limits[which], bytes(datagram[6:8])
            limits[number] = max(limits.get(number, 0), answer_limit(datagram))
        with contextlib.suppress(BlockingIOError):
            self._sockets[which].send(datagram)
            self.sent += 1
            self.octets_out += len(datagram)

    def look(self):
        """Check every answer that has come."""
        for one, limits in zip(self._sockets, self._limits, strict=True):
            with contextlib.suppress(BlockingIOError):
                while True:
                    answer = one.recv(65_536)
                    assert len(answer) <= limits[answer[6:8]], (answer, limits[answer[6:8]])
                    self.answers += 1
                    self.octets_in += len(answer)

    def close(self):
        for one in self._sockets:
            one.close()


def _resident_kb(pid):
    for line in Path(f"/proc/{pid}/status").read_text().splitlines():
        if line.startswith("VmRSS:"):
            return int(line.split()[1])
    raise AssertionError


def _part(number, count=400):
    return steady(count, 1 + number * 5000, 10, number, (1280, 720))


@pytest.fixture
def link():
    (setup,) = link_setups(parse_rig(RIG, "t.toml", "t"))
    made = LinkProcess(dataclasses.replace(setup, ring=EventRing(100_000)), MonotonicClock())
    made.wait_ready()
    yield made
    made.stop(0.0)


@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(0)
def test_the_stream_is_exact_whatever_strangers_send(link):
    draw, port = np.random.default_rng(8), int(link.report.address.rpartition(":")[2])
    host = GigeHost("127.0.0.1", port, now_ns=MonotonicClock().now_ns)
    host.start()
    host.write(Register.GVCP_CONFIGURATION, HEARTBEAT_OFF)
    link.start(FREE_RUNNING)
    with contextlib.closing(Strangers(port)) as strangers:
        for number in range(PARTS):
            for k in range(COUNT // PARTS):
                strangers.fire(draw, hostile_datagram(draw))
                if k % 100 == 0:
                    strangers.look()
                    host.read(0.0)
            link.push_all(_part(number), (number + 1) * 5000)
            seen = [host.read(0.1)]
            while sum(map(len, seen)) < 400:
                seen.append(host.read(0.1))
            assert np.concatenate(seen).tobytes() == _part(number).tobytes()
        strangers.look()
        assert 0 < strangers.answers <= strangers.sent
    assert host.assembly.lost == 0
    host.close()
    report = link.stop(60.0)
    assert (report.error, report.delivered) == (None, 400 * PARTS)


def _answer(owner, asked):
    """Return the answer to a request, which is sent again as a host does: a flood may fill the camera's buffer."""
    for _ in range(60):
        owner.send(asked)
        with contextlib.suppress(TimeoutError):
            while (answer := owner.recv(100))[6:8] != asked[6:8]:
                pass
            return answer
    raise AssertionError("no answer to a request that was sent 60 times")


@pytest.mark.long
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(0)
def test_the_process_that_answers_stays_small_and_at_work():
    draw, process = np.random.default_rng(9), ControlProcess(ControlSetup("127.0.0.1", 0, (), Triton2Settings(), 1))
    resident_kb = []
    with (
        contextlib.closing(process),
        contextlib.closing(Strangers(process.port)) as strangers,
        contextlib.closing(socket.socket(socket.AF_INET, socket.SOCK_DGRAM)) as owner,
    ):
        owner.settimeout(1.0)
        owner.connect(("127.0.0.1", process.port))
        for k in range(COUNT):
            if k % 500 == 0:
                control = (Register.PRIVILEGE, 2, Register.GVCP_CONFIGURATION, HEARTBEAT_OFF)
                asked = request(Command.WRITEREG, 1 + k % 0xFFFF, struct.pack(">4I", *control))
                assert _answer(owner, asked)[:2] == b"\0\0"
                asked = request(Command.READREG, 2 + k % 0xFFFE, struct.pack(">I", Register.PRIVILEGE))
                assert _answer(owner, asked)[8:] == b"\0\0\0\2"
                strangers.look()
                assert sum(1 for _ in process.take()) >= 0
                resident_kb.append(_resident_kb(process.pid))
            strangers.fire(draw, hostile_datagram(draw))
    assert resident_kb[-1] - resident_kb[len(resident_kb) // 4] < MOST_GROWTH_KB, resident_kb


@pytest.mark.system
@pytest.mark.timeout(0)
def test_valid_orders_in_any_order_leave_a_balanced_camera():
    draw = np.random.default_rng(10)
    camera = Triton2(Triton2Settings(start_delay_us=0, capacity=5000))
    control = Triton2Control(Triton2Settings(), lambda: DeviceTime(*camera.time))
    for k in range(COUNT):
        asked = [(valid_request(draw), OWNER)]
        if k % 50 == 0:
            begin = (Register.PRIVILEGE, 2, Register.STREAM_PORT, 5000, ACQUISITION_START, 1)
            asked.append((request(Command.WRITEREG, 9, struct.pack(">6I", *begin)), OWNER))
        for answer, _ in control.receive(asked, k * 100_000):
            assert len(answer) <= 548
        while control.orders:
            camera.obey(control.orders.popleft())
        if k % 7 == 0:
            events = _part(0, 20)
            events["t"] += np.uint64(camera.now_us)
            camera.offer(events)
            while (outgoing := camera.next_block()) is not None:
                camera.sent(outgoing)
            while camera.next_extra() is not None:
                pass
    counters = camera.counters
    assert counters.accounted == counters.offered == 20 * -(-COUNT // 7)
    assert counters.edges.accounted == counters.edges.offered + counters.edges.added
    assert counters.delivered > 0
