"""The process that answers hosts: what it tells the link, what it needs of it, and how both end."""

import contextlib
import mmap
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path

import pytest

from firmware_protocol.gige.control import DeviceTime, Owner, Write
from firmware_protocol.gige.gvcp import Command, Status, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, Triton2Settings
from firmware_protocol.ptp.slave import Timebase
from transports.gige.answering import TIME_CELLS, ControlSetup, read_timebase, write_timebase
from transports.gige.endpoint import ControlProcess
from transports.link.endpoint import LinkBroken

pytestmark = pytest.mark.socket
SETUP = ControlSetup("127.0.0.1", 0, (), Triton2Settings(), 4567)
LONELY = """
import sys, time
from firmware_protocol.imx636.triton2_registers import Triton2Settings
from firmware_protocol.ptp.slave import Timebase
from transports.gige.answering import TIME_CELLS, ControlSetup, read_timebase, write_timebase
from transports.gige.endpoint import ControlProcess
process = ControlProcess(ControlSetup("127.0.0.1", 0, (), Triton2Settings(), 1))
print(process.pid, flush=True)
sys.stdin.read()
"""


def _taken_for_ever(process):
    while True:
        list(process.take())


def _looked_for(number, seconds):
    deadline_s = time.monotonic() + seconds
    while time.monotonic() < deadline_s:
        os.kill(number, 0)


class Asker:
    """A host that asks and gets the answer's status and payload."""

    def __init__(self, port):
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.settimeout(120.0)
        self._socket.connect(("127.0.0.1", port))
        self._number = 0

    def __call__(self, command, *numbers):
        self._number = self._number % 0xFFFF + 1
        self._socket.send(request(command, self._number, struct.pack(f">{len(numbers)}I", *numbers)))
        answer = self._socket.recv(1000)
        assert struct.unpack_from(">H", answer, 6) == (self._number,)
        return int.from_bytes(answer[:2], "big"), answer[8:]

    def close(self):
        self._socket.close()


@pytest.fixture
def process():
    made = ControlProcess(SETUP)
    yield made
    made.close()


@pytest.fixture
def ask(process):
    with contextlib.closing(Asker(process.port)) as made:
        yield made


def test_it_and_its_session_run_before_others(process):
    autogroup = Path(f"/proc/{process.pid}/autogroup")
    if not autogroup.exists():
        pytest.skip("this kernel does not share processors out by session")
    if os.getpriority(os.PRIO_PROCESS, process.pid) > -20:
        pytest.skip("this user may not run at nice -20")
    assert autogroup.read_text().endswith(" nice -20\n")


def test_what_was_answered_has_been_handed_on_in_order(process, ask):
    ask(Command.WRITEREG, Register.PRIVILEGE, 2)
    for value in range(1000, 1200):
        assert ask(Command.WRITEREG, Register.HEARTBEAT_MS, value)[0] == 0
    ask(Command.READREG, Register.PRIVILEGE)
    owner, *writes = process.take()
    assert isinstance(owner, Owner)
    assert writes == [Write(Register.HEARTBEAT_MS, value) for value in range(1000, 1200)]


def test_the_latched_time_is_that_of_the_stream_since_the_last_start(process, ask):
    process.write_time(DeviceTime(0, 9_000_000))
    ask(Command.WRITEREG, Register.PRIVILEGE, 2)
    seen = []
    for step in (
        lambda: None,
        lambda: ask(Command.WRITEREG, ACQUISITION_START, 1),
        lambda: process.write_time(DeviceTime(1, 5000)),
    ):
        step()
        ask(Command.WRITEREG, Register.TIME_CONTROL, 2)
        seen.append(int.from_bytes(ask(Command.READREG, Register.TIME_HIGH, Register.TIME_LOW)[1], "big"))
    assert seen == [9_000_000, 0, 5000]
    assert ask(Command.READREG, Register.STREAM_SOURCE_PORT)[1] == (4567).to_bytes(4, "big")


@pytest.mark.system
def test_a_link_that_stands_still_does_not_keep_hosts_waiting(process, ask):
    ask(Command.WRITEREG, Register.PRIVILEGE, 2)
    statuses = {ask(Command.WRITEREG, Register.HEARTBEAT_MS, 6000 + k)[0] for k in range(30_000)}
    assert statuses == {Status.SUCCESS, Status.BUSY}
    assert ask(Command.READREG, Register.PRIVILEGE) == (0, b"\0\0\0\2")
    taken = 0
    while ask(Command.WRITEREG, Register.HEARTBEAT_MS, 5000)[0] == Status.BUSY:
        taken += sum(1 for _ in process.take())
    assert taken > 0


def test_a_process_that_was_killed_is_a_broken_link_with_a_reason(process):
    os.kill(process.pid, signal.SIGKILL)
    with pytest.raises(LinkBroken, match=r"the process that answers GigE Vision hosts has died \(exit code -9\)"):
        _taken_for_ever(process)


@pytest.mark.system
@pytest.mark.parametrize("end", [signal.SIGKILL, signal.SIGTERM])
def test_it_ends_with_its_link(end):
    link = subprocess.Popen([sys.executable, "-c", LONELY], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    number = int(link.stdout.readline())
    os.kill(number, 0)
    link.send_signal(end)
    link.communicate()
    with pytest.raises(ProcessLookupError):
        _looked_for(number, 120.0)


def test_it_counts_to_the_end():
    process = ControlProcess(SETUP)
    with contextlib.closing(Asker(process.port)) as ask:
        for _ in range(5):
            ask(Command.READREG, 0)
    process.close()
    assert process.counts["requests done"] == 5


def test_it_imports_nothing_large():
    script = "import sys, transports.gige.answering; print({'numpy', 'numba', 'asyncio'} & set(sys.modules))"
    told = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert told.stdout.strip() == "set()"


def test_the_masters_time_in_shared_memory_is_read_whole_or_as_before():
    memory, before, timebase = mmap.mmap(-1, 8 * TIME_CELLS), Timebase(1, 2, 3), Timebase(10**18, -(10**18), -77)
    assert read_timebase(memory, before) is None
    write_timebase(memory, timebase)
    assert read_timebase(memory, before) == timebase
    struct.pack_into("=q", memory, 16, 3)  # odd: it is being written
    assert read_timebase(memory, before) == before
    struct.pack_into("=q", memory, 16, 4)
    write_timebase(memory, Timebase(0, 1 << 70, 0))
    assert read_timebase(memory, before) == Timebase(0, (1 << 63) - 1, 0)
    write_timebase(memory, None)
    assert read_timebase(memory, before) is None
    assert struct.unpack_from("=2q", memory) == (0, 0)  # the link's own cells
