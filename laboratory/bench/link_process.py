"""Processor time of the process of each kind of link: without a host, and with a host that reads.

    python -m laboratory.bench.link_process [SECONDS [NAME ...]]

NAME is one or more of usbip, gige, serial, can and file (all by default), SECONDS the length of each measurement (5 by
default). A rig's link runs in a process of its own, as in a run, and is fed each millisecond with nothing or with the
events of a saturated read-out, 1.5 million a second. The host is `evstim listen` in another process; a file has none.
A serial line (3 Mbaud) and a CAN bus (1 Mbit/s) carry fewer events, and their camera drops the others.

For each case a row: processor time of the link's process in percent of a core, voluntary context switches of that
process a second (its sleeps), and the events that it delivered a second. Exit code 1 where a host does not get all
events that its link delivers, or where USB/IP, GigE or the file deliver less than 95 % of the events in this time.
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkProcess
from firmware_protocol.events import Events, empty_events
from laboratory.bench.streams import saturated_stream, say
from laboratory.realtime.program import use_of
from transports.link.pacing import MonotonicClock
from transports.link.report import LinkReport

EVENT_NS = 667  # 1.5 Mev/s
_STEP_US = 1000
_LEAD_NS = 5_000_000  # events are published so long before they are due, as in a run
_BLOCK_US = 1_000_000
_PATIENCE_S = 60.0
_LEAST = 0.95  # of the events, by links that can carry all
_SETTLE_S = 1.0  # the host is present, and the first ticks have passed


@dataclass(frozen=True)
class Kind:
    """One kind of link: the tables of its rig, the command of its host, and if it can carry all events.

    The command is empty if there is no host; {address} and {rig} stand for the link's address and the rig's path.
    """

    rig: str
    host: tuple[str, ...] = ()
    carries_all: bool = True


_INSTRUMENT = "[links.instrument]\nhousekeeping_s = 1.0"
KINDS = {
    "usbip": Kind('[[links]]\nkind = "usbip"\nport = 0', ("listen", "--usbip", "{address}")),
    "gige": Kind('[camera]\nmodel = "triton2"\n[[links]]\nkind = "gige"', ("listen", "gige", "{address}")),
    "serial": Kind(
        f'[[links]]\nkind = "serial"\nbaud = 3_000_000\n{_INSTRUMENT}',
        ("listen", "serial", "{address}", "--baud", "3000000"),
        carries_all=False,
    ),
    "can": Kind(f'[[links]]\nkind = "can"\nport = 29536\n{_INSTRUMENT}', ("listen", "can", "{rig}"), carries_all=False),
    "file": Kind('[[links]]\nkind = "file"\npath = "{folder}/out.aedat4"'),
}


@dataclass(frozen=True)
class Used:
    """Processor time, s, and voluntary context switches of a process so far."""

    cpu_s: float
    sleeps: int

    @classmethod
    def by(cls, pid: int | None) -> Used:
        """Return those of a running process."""
        use = None if pid is None else use_of(pid)
        if use is None:
            raise SystemExit("the link's process has ended")
        status = Path(f"/proc/{pid}/status").read_text()
        sleeps = int(status.rpartition("\nvoluntary_ctxt_switches:")[2].split()[0])
        return cls(use.cpu_s, sleeps)


@dataclass(frozen=True)
class Measured:
    """Use of a core, 0 to 1, sleeps, and delivered events a second; the last report of the link."""

    core: float
    sleeps_hz: float
    delivered_hz: float
    report: LinkReport


def opened(table: str, folder: Path) -> tuple[LinkProcess, Path]:
    """Return a link, ready to start, and the path of its rig."""
    path = folder / "bench.toml"
    text = f'[scene]\nkind = "checkerboard"\n{table.format(folder=folder)}\n'
    path.write_text(text)
    (setup,) = link_setups(parse_rig(text, str(path), "bench"))
    link = LinkProcess(setup, MonotonicClock())
    link.wait_ready()
    return link, path


@contextmanager
def host(kind: Kind, link: LinkProcess, rig: Path) -> Iterator[subprocess.Popen[str]]:
    """Run the host of a link in another process."""
    values = {"address": link.report.address or "", "rig": str(rig)}
    command = [sys.executable, "-m", "evstim", *(part.format(**values) for part in kind.host), "--json"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as process:
        try:
            _wait_present(link, process)
            yield process
        finally:
            process.kill()


def _wait_present(link: LinkProcess, process: subprocess.Popen[str]) -> None:
    """Wait until the state of the link has changed, which it does when a host comes."""
    alone, until_s = link.listen().state, time.monotonic() + _PATIENCE_S
    while link.listen().state == alone:
        if process.poll() is not None or time.monotonic() > until_s:
            raise SystemExit(f"the host did not come: {alone}")
        time.sleep(0.05)


class Stream:
    """Events in real time, in steps of a millisecond: `rate` True for 1.5 million a second, False for none."""

    def __init__(self, link: LinkProcess, *, has_events: bool) -> None:
        self._link = link
        block = saturated_stream(_BLOCK_US * 1000 // EVENT_NS, EVENT_NS) if has_events else empty_events()
        self._steps = np.split(block, np.searchsorted(block["t"], np.arange(_STEP_US, _BLOCK_US, _STEP_US)))
        self._reached_us = 0
        self._begun_ns = MonotonicClock().now_ns()
        link.start(self._begun_ns + _LEAD_NS)

    def go_on(self, seconds: float) -> None:
        """Push the events of the next seconds, each step at its end."""
        until_us = self._reached_us + round(seconds * 1e6)
        while self._reached_us < until_us:
            events = self._next()
            self._reached_us += _STEP_US
            time.sleep(max(0.0, (self._begun_ns + self._reached_us * 1000 - MonotonicClock().now_ns()) * 1e-9))
            self._link.push(events, self._reached_us)
            self._link.listen()  # a pipe full of old reports takes no new one

    def _next(self) -> Events:
        events = self._steps[self._reached_us % _BLOCK_US // _STEP_US].copy()
        events["t"] += self._reached_us // _BLOCK_US * _BLOCK_US
        return events


def measured(link: LinkProcess, seconds: float, *, has_events: bool, is_read: bool) -> Measured:
    """Return the use of a core by a link that is fed for some seconds, once its reader gets events."""
    stream, until_s = Stream(link, has_events=has_events), time.monotonic() + _PATIENCE_S
    stream.go_on(_SETTLE_S)
    while has_events and is_read and not link.listen().delivered and time.monotonic() < until_s:
        stream.go_on(_SETTLE_S)
    before, delivered, begun_s = Used.by(link.pid), link.listen().delivered, time.monotonic()
    stream.go_on(seconds)
    after, now, wall_s = Used.by(link.pid), link.listen(), time.monotonic() - begun_s
    return Measured(
        (after.cpu_s - before.cpu_s) / wall_s,
        (after.sleeps - before.sleeps) / wall_s,
        (now.delivered - delivered) / wall_s,
        link.stop(1.0),
    )


def case(name: str, seconds: float, *, has_host: bool, has_events: bool) -> tuple[Measured, str]:
    """Return what one case uses, and what is wrong, "" for nothing."""
    kind = KINDS[name]
    with tempfile.TemporaryDirectory() as folder:
        link, rig = opened(kind.rig, Path(folder))
        if not has_host:
            used = measured(link, seconds, has_events=has_events, is_read=not kind.host)
            received = used.report.delivered
        else:
            with host(kind, link, rig) as process:
                used = measured(link, seconds, has_events=has_events, is_read=True)
                received = _received(process)
    if used.report.error is not None or received != used.report.delivered:
        return used, f"{received} received of {used.report.delivered} delivered, {used.report.error}"
    is_full = has_events and kind.carries_all and has_host == bool(kind.host)
    return used, "too few events" if is_full and used.delivered_hz < _LEAST * 1e9 / EVENT_NS else ""


def _received(process: subprocess.Popen[str]) -> int:
    """End a host, and return the number of events that it has received."""
    process.send_signal(signal.SIGINT)
    lines = (process.stdout.read() if process.stdout else "").splitlines()
    return int(json.loads(lines[-1])["events"])


def main(seconds: float, *names: str) -> int:
    """Measure each kind of link and print a table."""
    good = True
    say("| link | host | events | % of a core | sleeps a second | delivered, Mev/s |\n|---|---|---|---|---|---|")
    for name in names or KINDS:
        for has_host in (False, True)[: 2 if KINDS[name].host else 1]:
            for has_events in (False, True):
                used, trouble = case(name, seconds, has_host=has_host, has_events=has_events)
                good &= not trouble
                cells = name, "reads" if has_host else "none", "1.5 Mev/s" if has_events else "none"
                numbers = f"{100 * used.core:.1f}", f"{used.sleeps_hz:.0f}", f"{used.delivered_hz * 1e-6:.2f}"
                say(f"| {' | '.join((*cells, *numbers))} |{f' {trouble}' * bool(trouble)}")
    say(f"load {os.getloadavg()[0]:.1f}")
    return int(not good)


if __name__ == "__main__":
    sys.exit(main(float(sys.argv[1]) if sys.argv[1:] else 5.0, *sys.argv[2:]))
