"""Events a second through links that write files and streams, each to a reader that we did not write, and all compared.

    python -m laboratory.benchmarks.streams [EVENTS [NAME ...]]

NAME is one or more of aedat4, evt3, dv and jaer (all by default), EVENTS 10^7 by default. The events are those of a
saturated read-out (12.5 Mev/s), but for jaer, which sends 1 Mev/s in real time; the others go as fast as the link takes
them. Files are read back by faery (AEDAT 4.0) and evt3, streams in another process: that of dv by dv_processing, that
of jaer by a receiver with twice the receive buffer that jAER requests. Seconds count from the first event to the whole
file, or to the reader's last event; beside them the processor time of the link and of the process that writes the file.
Exit code 1 where an event is missing or wrong, or where fewer than 10 million (jaer: all of its million) a second come.
"""

from __future__ import annotations

import contextlib
import os
import resource
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np

from emulator.rig.loading import parse_rig
from emulator.run.assembly import link_setups
from emulator.run.link_process import LinkProcess
from firmware_protocol.events import Events, make_events
from laboratory.bench.streams import saturated_stream
from transports.link.pacing import MonotonicClock
from transports.link.report import LinkReport
from transports.link.rings import FREE_RUNNING

SIZE = (346, 260)
LEAST_MEV_S = {"aedat4": 10.0, "evt3": 10.0, "dv": 10.0, "jaer": 0.98}
JAER_NS = 1000  # between events
_BLOCK = 1 << 16
_STEP = 1000  # events between pushes at 1 Mev/s: 1 ms

Measured = tuple[float, "ProcessorTime", str]
"""Seconds, processor time, and what is wrong."""


def opened(table: str) -> LinkProcess:
    """Return a link, ready to start."""
    (setup,) = link_setups(parse_rig(f'[scene]\nkind = "checkerboard"\n[[links]]\n{table}\n', "bench.toml", "bench"))
    link = LinkProcess(setup, MonotonicClock())
    link.wait_ready()
    return link


def push_freely(link: LinkProcess, events: Events) -> None:
    """Push all as fast as they are taken."""
    link.start(FREE_RUNNING)
    for start in range(0, len(events), _BLOCK):
        part = events[start : start + _BLOCK]
        link.push_all(part, int(part["t"][-1]))


def push_in_time(link: LinkProcess, events: Events) -> None:
    """Push each millisecond's events at its end."""
    begun_ns = MonotonicClock().now_ns()
    link.start(begun_ns)
    for start in range(0, len(events), _STEP):
        part = events[start : start + _STEP]
        until_us = int(part["t"][-1])
        time.sleep(max(0.0, (begun_ns + until_us * 1000 - MonotonicClock().now_ns()) * 1e-9))
        link.push(part, until_us)


class ProcessorTime:
    """Processor time of a link, and of the process that writes its file, from when it is ready to its end, seconds."""

    def __init__(self, table: str) -> None:
        self._before_s = children_s()
        self.link = opened(table)
        self._ready_s = [own_s(self.link.pid), *map(own_s, _children(self.link.pid))]
        self.link_s = self.writer_s = 0.0

    def stopped(self, count: int) -> LinkReport:
        """Stop the link when it has delivered `count` events or for a minute delivered none; return its last report."""
        until_s, delivered = time.monotonic() + 60, -1
        while (now := self.link.listen()).delivered < count and time.monotonic() < until_s:
            if now.delivered != delivered:
                delivered, until_s = now.delivered, time.monotonic() + 60
            time.sleep(0.01)
        before_s = own_s(self.link.pid)
        report = self.link.stop(60.0)
        self.link_s = before_s - self._ready_s[0]
        self.writer_s = max(0.0, children_s() - self._before_s - before_s - sum(self._ready_s[1:]))
        return report


def children_s() -> float:
    """Return the processor time of all children that have ended and were waited for."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def own_s(pid: int | None) -> float:
    """Return the processor time of a running process."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")


def _children(pid: int | None) -> list[int]:
    return [int(child) for child in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def wrong(have: Events, sent: Events) -> str:
    """Return what is wrong with events that came, "" for nothing."""
    if len(have) != len(sent):
        return f"{len(have)} of {len(sent)} events"
    differ = sum(int(np.count_nonzero(have[name] != sent[name])) for name in ("t", "x", "y", "on"))
    return f"{differ} values differ" if differ else ""


def file_back(path: Path) -> Events:
    """Return the events of a file as a program of others reads them."""
    if path.suffix == ".raw":
        import evt3

        read = evt3.decode_file(str(path))
        return make_events(read.t, read.x, read.y, np.asarray(read.p) > 0)
    import faery

    parts = np.concatenate(list(faery.events_stream_from_file(path)))
    return make_events(*(parts[name] for name in ("t", "x", "y", "on")))


def file_measured(name: str, sent: Events, folder: Path) -> Measured:
    """Return what a file costs that a link writes."""
    path = folder / f"out{'.raw' if name == 'evt3' else '.aedat4'}"
    used = ProcessorTime(f'kind = "file"\npath = "{path}"')
    begun_s = time.monotonic()
    push_freely(used.link, sent)
    report = used.stopped(len(sent))
    seconds = time.monotonic() - begun_s
    have = file_back(path)
    have["t"] -= have["t"][0] - sent["t"][0] if name == "aedat4" else np.uint64(0)  # its times are Unix time
    return seconds, used, wrong(have, sent) or _trouble(report, len(sent))


def dv_measured(sent: Events, folder: Path) -> Measured:
    """Return the same of the stream of dv."""
    used = ProcessorTime('kind = "tcp"\nport = 0')
    link = used.link
    with reader("dv", (link.report.address or "").rpartition(":")[2], len(sent), folder) as process:
        while "waiting" in link.listen().state:
            time.sleep(0.01)
        begun_s = time.monotonic()
        push_freely(link, sent)
        _next_line(process)
        seconds = time.monotonic() - begun_s
        report = used.stopped(len(sent))
        _next_line(process)
    return seconds, used, wrong(np.load(folder / "have.npy"), sent) or _trouble(report, len(sent))


def jaer_measured(sent: Events, folder: Path) -> Measured:
    """Return the same of the datagrams of jaer, in real time."""
    with reader("jaer", "0", len(sent), folder) as process:
        used = ProcessorTime(f'kind = "udp"\nport = {_next_line(process)}\nmbit_s = 1000.0')
        begun_s = time.monotonic()
        push_in_time(used.link, sent)
        _next_line(process)
        seconds = time.monotonic() - begun_s
        report = used.stopped(len(sent))
        gaps = _next_line(process)
    troubles = (wrong(np.load(folder / "have.npy"), sent), f"{gaps} gaps" * (gaps != "0"), _trouble(report, len(sent)))
    return seconds, used, ", ".join(filter(None, troubles))


@contextlib.contextmanager
def reader(name: str, port: str, count: int, folder: Path) -> Iterator[subprocess.Popen[str]]:
    """Start this program as a reader of `count` events; it reports when it has them and when they are in have.npy."""
    command = [sys.executable, __file__, "--read", name, port, str(count), str(folder / "have.npy")]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            yield process
        finally:
            process.kill()


def read_dv(port: int, count: int, path: Path) -> None:
    """Read `count` events as programs of iniVation's users do."""
    import dv_processing

    client, batches, have = dv_processing.io.NetworkReader("127.0.0.1", port), [], 0
    while have < count:
        if (batch := client.getNextEventBatch()) is None:
            time.sleep(1e-4)
            continue
        batches.append(batch)
        have += batch.size()
    say("all")
    read = np.concatenate([batch.numpy() for batch in batches])
    np.save(path, make_events(*(read[name] for name in ("timestamp", "x", "y", "polarity"))))
    say("saved")


def read_jaer(count: int, path: Path) -> None:
    """Read datagrams until `count` events have come or nothing has for three seconds; decoded from the documents."""
    receiver = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    for option in (33, socket.SO_RCVBUF):  # SO_RCVBUFFORCE goes beyond the machine's limit, where that is allowed
        with contextlib.suppress(OSError):
            receiver.setsockopt(socket.SOL_SOCKET, option, 16 << 20)
            break
    receiver.bind(("127.0.0.1", 0))
    say(str(receiver.getsockname()[1]))
    datagrams, have = [], 0
    with contextlib.suppress(TimeoutError):
        while have < count:
            datagrams.append(receiver.recv(1 << 16))
            receiver.settimeout(3.0)
            have += len(datagrams[-1]) // 8
    say("all")
    numbers = np.array([int.from_bytes(one[:4], "big") for one in datagrams])
    words = np.frombuffer(b"".join(one[4:] for one in datagrams), ">u4").reshape(-1, 2)
    at, on = words[:, 0], (words[:, 0] >> 11 & 1).astype(bool)
    x, y = SIZE[0] - 1 - (at >> 12 & 0x3FF), SIZE[1] - 1 - (at >> 22 & 0x1FF)
    np.save(path, make_events(words[:, 1], x, y, on))
    say(str(int(np.count_nonzero(np.diff(numbers) != 1)) + int(numbers[0] != 1)))


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()


def _next_line(process: subprocess.Popen[str]) -> str:
    """Return the reader's next line."""
    line = process.stdout.readline().strip() if process.stdout else ""
    if not line:
        raise SystemExit("the reader ended without an answer")
    return line


def _trouble(report: LinkReport, count: int) -> str:
    """Return the trouble that the link itself reports."""
    if report.error is None and report.delivered == count:
        return ""
    return f"{report.delivered} delivered, {report.dropped} dropped, {report.error}"


def main(count: float = 1e7, *names: str) -> int:
    """Measure each of them and print a line."""
    good = True
    for name in names or LEAST_MEV_S:
        sent = saturated_stream(int(count), JAER_NS) if name == "jaer" else saturated_stream(int(count))
        with tempfile.TemporaryDirectory() as folder:
            by_name = {"dv": dv_measured, "jaer": jaer_measured}
            measure = by_name[name](sent, Path(folder)) if name in by_name else file_measured(name, sent, Path(folder))
        seconds, used, trouble = measure
        link_ns, writer_ns = (one / len(sent) * 1e9 for one in (used.link_s, used.writer_s))
        rate = len(sent) / seconds * 1e-6
        good &= not trouble and rate >= LEAST_MEV_S[name]
        say(f"{name}: {rate:.2f} Mev/s, {len(sent)} events in {seconds:.2f} s; processor time an event: link "
            f"{link_ns:.0f} ns, writer {writer_ns:.0f} ns; load {os.getloadavg()[0]:.1f}; "
            f"{trouble or 'all equal'}")  # fmt: skip
    return int(not good)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--read"]:
        if sys.argv[2] == "dv":
            read_dv(int(sys.argv[3]), int(sys.argv[4]), Path(sys.argv[5]))
        else:
            read_jaer(int(sys.argv[4]), Path(sys.argv[5]))
        sys.exit(0)
    sys.exit(main(*map(float, sys.argv[1:2]), *sys.argv[2:]))
