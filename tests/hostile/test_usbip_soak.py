"""A free-running camera read over USB/IP: every event compared, memory sampled, ledger balanced. At length:

    EVSTIM_SOAK_EVENTS=1e9 python -m pytest tests/hostile/test_usbip_soak.py -k dense --timeout 0
    EVSTIM_SOAK_HOURS=24 python -m pytest tests/hostile/test_usbip_soak.py -k wrap --timeout 0

The camera plays a recording in a loop, so that what must come is known from the recording alone (see `looped`). The
reader is evstim's own USB/IP host and DAVIS driver in this process; the run is `evstim run`, in two processes.
"""

from __future__ import annotations

import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import dataclass

import pytest

from tests.hostile.looped import Follower, Looped
from tests.hostile.memory import MemoryLog
from transports.link.deliveries import digest_of
from transports.usb.davis_host import DavisHost
from transports.usb.usbip.client import UsbipHost

RIG = """
title = "a loop of recorded events as fast as its reader takes them"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
model = "davis346"
start_delay_ms = 300
[run]
pace = "free"
step_us = {step_us}
[[links]]
kind = "usbip"
port = 0
"""
RUN = [sys.executable, "-c", "from emulator.cli import main; main()", "run"]
EVENTS_A_STEP = 20_000
EVENTS = round(float(os.environ.get("EVSTIM_SOAK_EVENTS", "3e6")))
HOURS = float(os.environ.get("EVSTIM_SOAK_HOURS", "0"))
MOST_GROWN = 8 << 20


@dataclass(frozen=True)
class Plan:
    """How far a soak goes: so many events, or so much device time, whichever is later.

    Attributes
    ----------
    loop : events of the recording.
    gap_us : their mean distance.
    """

    events: int
    device_us: int
    loop: int
    gap_us: int


class FreeRun:
    """`evstim run` of a loop, not paced, until `stop`.

    Attributes
    ----------
    port : where its camera is.
    processes : numbers of its processes, by name.
    """

    def __init__(self, looped, folder):
        rig, ready = folder / "soak.toml", folder / "ready"
        looped.save(folder / "looped.npz")
        step_us = max(1, EVENTS_A_STEP * looped.round_us // len(looped.events))
        rig.write_text(RIG.format(step_us=min(step_us, 1_000_000)))
        command = [*RUN, str(rig), "--json", "--seconds", "3.2e7", "--ready-file", str(ready)]
        self._run = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        try:
            while not ready.exists():
                assert self._run.poll() is None, "the run ended at once"
                time.sleep(0.05)
        except BaseException:
            self._run.kill()
            raise
        self.port = int(json.loads(ready.read_text())["links"]["usbip"].rpartition(":")[2])
        found = subprocess.run(["pgrep", "-P", str(self._run.pid), "-f", "spawn_main"], capture_output=True, text=True)
        self.processes = {"session": self._run.pid, "link": int(found.stdout.split()[0])}

    def stop(self):
        """End it as Ctrl-C does and return its summary."""
        self._run.send_signal(signal.SIGINT)
        out, _ = self._run.communicate(timeout=60)
        return json.loads(out.splitlines()[-1])

    def close(self):
        """End it in any case."""
        self._run.kill()
        self._run.wait()


PLANS = {
    "dense": Plan(EVENTS, 0, loop=300_000, gap_us=3),
    "through a wrap": Plan(0, max((1 << 31) + 10**8, round(HOURS * 3.6e9)), loop=50_000, gap_us=20_000),
}


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(300 + EVENTS // 10_000 + HOURS * 3600)
@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_every_event_is_as_recorded_and_memory_stays(plan, tmp_path):
    looped = Looped(plan.loop, plan.gap_us)
    with contextlib.closing(FreeRun(looped, tmp_path)) as run:
        camera = DavisHost(UsbipHost.attach(port=run.port, timeout_s=60.0))
        memory = MemoryLog({**run.processes, "reader": None})
        follower, digest = Follower(looped), 0
        camera.start()
        while follower.seen < plan.events or follower.last_us < plan.device_us:
            events = camera.read(10.0)
            assert events is not None, f"no event for 10 s after {follower.seen}"
            digest = digest_of(events, digest)
            follower.take(events)
            if memory.due():
                memory.sample(follower.seen)
        rest = camera.stop()
        digest = digest_of(rest, digest)
        follower.take(rest)
        assert camera.faults.total == 0, camera.faults
        camera.close()
        summary = run.stop()
    link, fates = summary["links"]["usbip"], summary["events"]["links"]["usbip"]
    assert summary["balanced"], summary
    assert link["error"] is None, link
    assert link["digest"] == digest, (link["digest"], digest)
    assert fates["delivered"] >= follower.seen, fates  # those before the timestamp reset are not the reader's
    assert fates["dropped"] == link["dropped_in_device"]["dropped_fifo"] == 0, summary
    assert all(grown < MOST_GROWN for grown in memory.grown().values()), memory.grown()
