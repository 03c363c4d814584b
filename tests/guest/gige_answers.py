"""Time until a GigE Vision camera answers while it streams on a busy machine.

    python -m tests.guest.gige_answers [REQUESTS] [BUSY_LOOPS] [FIFO_PRIORITY]

A rig plays 3 million events a second to a host that has control and reads a register every 2 ms. BUSY_LOOPS
processes do nothing but compute. The time of an answer is the kernel's own stamp of its arrival at the host's socket,
and the host runs before everything else where that is allowed: its waiting for a processor is no part of the time.
"""

import json
import os
import socket
import struct
import subprocess
import sys
import tempfile
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import numpy as np

from firmware_protocol.gige.gvcp import Command, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START
from tests.guest.gige_run import HD, GigeRun
from tests.hostile.looped import Looped

_SO_TIMESTAMPNS = 35  # Linux: asm-generic/socket.h
_EVENTS = 1_000_000
_EVENTS_PER_US = 3.0
_PERIOD_S = 0.002
_PATIENCE_S = 20.0
_LONGEST_S = 120.0
_DRIVERS_PATIENCE_MS = 25.0  # neuromorphic_drivers


class Host:
    """Has control of a camera whose stream goes to an unread socket."""

    def __init__(self, address, port):
        self._number = 0
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._control.setsockopt(socket.SOL_SOCKET, _SO_TIMESTAMPNS, 1)
        self._control.settimeout(_PATIENCE_S)
        self._control.connect((address, port))
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.bind(("127.0.0.1", 0))

    def start(self):
        """Take control and start the stream."""
        port = self._stream.getsockname()[1]
        settings = ((Register.PRIVILEGE, 2), (Register.PACKET_SIZE, 9000), (Register.STREAM_ADDRESS, 0x7F000001))
        for address, value in (*settings, (Register.STREAM_PORT, port), (ACQUISITION_START, 1)):
            self.answered_ns(Command.WRITEREG, struct.pack(">II", address, value))

    def answered_ns(self, command, payload):
        """Return the time from before the request to the arrival of its answer; raises TimeoutError."""
        self._number = self._number % 0xFFFF + 1
        sent_ns = time.clock_gettime_ns(time.CLOCK_REALTIME)
        self._control.send(request(command, self._number, payload))
        while True:
            data, stamps, _, _ = self._control.recvmsg(1024, 64)
            if int.from_bytes(data[6:8], "big") == self._number:
                seconds, nanoseconds = struct.unpack("qq", stamps[0][2][:16])
                return int(seconds * 1_000_000_000 + nanoseconds - sent_ns)


@contextmanager
def busy(loops):
    """Keep the machine busy."""
    processes = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(loops)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()


def measured_ns(host, count):
    """Return the times of `count` answers, fewer where that takes too long, to writes and reads of the driver."""
    times = []
    end_s = time.monotonic() + _LONGEST_S
    for k in range(count):
        if time.monotonic() > end_s:
            break
        due_s = time.monotonic() + _PERIOD_S
        if k % 2:
            times.append(host.answered_ns(Command.WRITEREG, struct.pack(">II", Register.HEARTBEAT_MS, 6000)))
        else:
            times.append(host.answered_ns(Command.READREG, struct.pack(">I", Register.PRIVILEGE)))
        time.sleep(max(0.0, due_s - time.monotonic()))
    return times


def main():
    """Measure and print."""
    numbers = [int(argument) for argument in sys.argv[1:]]
    count, loops, priority = [*numbers, *(10_000, 6, 0)[len(numbers) :]]
    looped = Looped(_EVENTS, 1, HD)
    draw = np.random.default_rng(3)
    looped.events["t"] = np.sort(draw.integers(0, round(_EVENTS / _EVENTS_PER_US), _EVENTS))
    address = f"127.0.7.{1 + os.getpid() % 250}"
    with tempfile.TemporaryDirectory() as folder, busy(loops):
        keys = f'host = "{address}"\nmbit_s = 20000\n'
        run = GigeRun(Path(folder), keys, looped, run=f"fifo_priority = {priority}")
        try:
            host = Host(address, 3956)
            host.start()
            with suppress(PermissionError):
                os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(60))
            times_ms = np.array(measured_ns(host, count)) * 1e-6
        finally:
            run.kill()
    told = {f"ms_{share}": round(float(np.percentile(times_ms, share)), 3) for share in (50, 99, 99.9, 100)}
    late = int((times_ms > _DRIVERS_PATIENCE_MS).sum())
    told |= {"requests": len(times_ms), "busy_loops": loops, "late": late, "load": os.getloadavg()}
    sys.stdout.write(json.dumps(told) + "\n")


if __name__ == "__main__":
    main()
