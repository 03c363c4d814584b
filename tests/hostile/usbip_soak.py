"""A free-running camera read over USB/IP for a long time: every event compared, memory sampled, ledger balanced.

    python -m tests.hostile.usbip_soak --events 1e9                         as many events as that, 3 us apart
    python -m tests.hostile.usbip_soak --hours 24 --gap-us 10000            so much device time

The camera plays a recording in a loop, so that what must come is known from the recording alone (see `looped`). The
reader is evstim's own USB/IP host and DAVIS driver in this process; the run is `evstim run`, in two processes.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

from tests.hostile.looped import Follower, Looped
from tests.hostile.memory import MemoryLog
from transports.link.deliveries import digest_of
from transports.usb.davis_host import DavisHost
from transports.usb.usbip.client import UsbipHost

__all__ = ["FreeRun", "Outcome", "Plan", "free_run", "soak"]

RIG = """
title = "a loop of recorded events as fast as its reader takes them"
[scene]
kind = "recording"
path = "looped.npz"
[camera]
model = "davis346"
start_delay_ms = {start_delay_ms}
[run]
pace = "free"
step_us = {step_us}
[[links]]
kind = "usbip"
port = 0
"""
RUN = [sys.executable, "-c", "from emulator.cli import main; main()", "run"]
EVENTS_A_STEP = 20_000


@dataclass(frozen=True)
class Plan:
    """How far a soak goes: so many events, or so much device time, whichever is later.

    Attributes
    ----------
    loop : events of the recording.
    gap_us : their mean distance.
    """

    events: int = 0
    device_us: int = 0
    loop: int = 2_000_000
    gap_us: int = 3


@dataclass(frozen=True)
class Outcome:
    """What a soak saw: the reader's events and digest, device time at its end, wall time, and the run's summary."""

    events: int
    digest: int
    device_us: int
    seconds: float
    summary: dict
    memory: MemoryLog

    def check(self) -> None:
        """Raise AssertionError where the run's account and the reader's differ; each event was compared before."""
        link, fates = self.summary["links"]["usbip"], self.summary["events"]["links"]["usbip"]
        assert self.summary["balanced"], self.summary
        assert link["error"] is None, link
        assert link["digest"] == self.digest, (link["digest"], self.digest)
        assert fates["delivered"] >= self.events, fates  # those before the timestamp reset are not the reader's
        assert fates["dropped"] == link["dropped_in_device"]["dropped_fifo"] == 0, self.summary


class FreeRun:
    """`evstim run` of a loop, not paced, until `stop`.

    Attributes
    ----------
    port : where its camera is.
    processes : numbers of its processes, by name.
    record : what was delivered, after the end; None where it is not kept.

    `tables` are more of the rig, TOML.
    """

    def __init__(
        self, looped: Looped, folder: Path, start_delay_ms: int = 300, *, record: bool = False, tables: str = ""
    ) -> None:
        rig, ready = folder / "soak.toml", folder / "ready"
        looped.save(folder / "looped.npz")
        step_us = max(1, EVENTS_A_STEP * looped.round_us // len(looped.events))
        rig.write_text(RIG.format(step_us=min(step_us, 1_000_000), start_delay_ms=start_delay_ms) + tables)
        command = [*RUN, str(rig), "--json", "--seconds", "3.2e7", "--ready-file", str(ready)]
        self.record = folder / "delivered.npz" if record else None
        command += ["--record", str(self.record)] if record else []
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

    def stop(self) -> dict:
        """End it as Ctrl-C does and return its summary."""
        self._run.send_signal(signal.SIGINT)
        out, _ = self._run.communicate(timeout=60)
        return json.loads(out.splitlines()[-1])

    def kill(self) -> None:
        """End it in any case."""
        self._run.kill()
        self._run.wait()


@contextlib.contextmanager
def free_run(looped: Looped, start_delay_ms: int = 300, *, record: bool = False) -> Iterator[FreeRun]:
    """A run that ends with the block."""
    with tempfile.TemporaryDirectory() as folder:
        run = FreeRun(looped, Path(folder), start_delay_ms, record=record)
        try:
            yield run
        finally:
            run.kill()


def soak(plan: Plan, say=lambda line: None) -> Outcome:
    """Read until the plan is done; raises AssertionError at the first event that is not as recorded."""
    looped = Looped(plan.loop, plan.gap_us)
    with free_run(looped) as run:
        camera = DavisHost(UsbipHost.attach(port=run.port, timeout_s=60.0))
        memory = MemoryLog({**run.processes, "reader": None})
        follower, digest, start_s = Follower(looped), 0, time.monotonic()
        camera.start()
        while follower.seen < plan.events or follower.last_us < plan.device_us:
            events = camera.read(10.0)
            assert events is not None, f"no event for 10 s after {follower.seen}"
            digest = digest_of(events, digest)
            follower.take(events)
            if memory.due():
                memory.sample(follower.seen)
                say(f"{follower.seen} events, {follower.last_us / 3.6e9:.3f} h: {memory.newest}")
        seconds = time.monotonic() - start_s
        rest = camera.stop()
        digest = digest_of(rest, digest)
        follower.take(rest)
        assert camera.faults.total == 0, camera.faults
        camera.close()
        return Outcome(follower.seen, digest, follower.last_us, seconds, run.stop(), memory)


def main() -> None:
    """Run one soak and print what it measured."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--events", type=float, default=0)
    parser.add_argument("--hours", type=float, default=0)
    parser.add_argument("--gap-us", type=int, default=3)
    parser.add_argument("--loop", type=int, default=2_000_000)
    given = parser.parse_args()
    plan = Plan(int(given.events), round(given.hours * 3.6e9), given.loop, given.gap_us)
    outcome = soak(plan, lambda line: print(line, flush=True))
    outcome.check()
    print(
        f"{outcome.events} events and {outcome.device_us / 3.6e9:.3f} h of device time in {outcome.seconds:.0f} s, "
        f"digest {outcome.digest:08x} on both sides, each event as recorded, ledger balanced"
    )
    for line in outcome.memory.told():
        print(line)


if __name__ == "__main__":
    main()
