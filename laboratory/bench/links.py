"""Links under load: events a second and latency over USB/IP, a serial line's share that arrives, events into a file.

Three processes, as in a run: this one feeds the ring; the link's own process holds the camera and the USB/IP server;
a receiver attaches over TCP on the loopback interface, acts as a driver, decodes every word, and digests every event;
or a computer opens the pty of a line of 3 Mbaud, decodes every block and digests every event. A file is read back.
"""

from __future__ import annotations

import dataclasses
import functools
import importlib.util
import multiprocessing
from dataclasses import dataclass
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Literal

import numpy as np

from emulator.rig.loading import load_rig, parse_rig
from emulator.run.assembly import build_scene, build_session, link_setups, schedule
from emulator.run.link_process import LinkProcess
from emulator.run.outcome import RunResult, RunStatus
from emulator.scene.checkerboard.table import CheckerboardParameters
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from laboratory.bench.streams import SIZE, BenchFailed, saturated_stream, stars
from transports.link.deliveries import LatencySummary
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup
from transports.link.report import LinkReport
from transports.link.rings import FREE_RUNNING, EventRing
from transports.output_file import TemporaryFolder
from transports.reception import InstrumentReception, Reception
from transports.recording.files import read_events
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import listen_serial
from transports.usb.cameras import receive
from transports.usb.davis_host import DavisHost
from transports.usb.kind import UsbipLink
from transports.usb.usbip.client import UsbipHost
from transports.usb.usbip.endpoint import UsbipFactory

_SUSTAINED_S = 10.0
_BLOCK = 1_000_000
_LATENCY_SPEED_PX_S = 60.0
_LATENCY_STEP_US = 1000


class _Receiver:
    """A receiver in a process of its own."""

    def __init__(self, address: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._mine, theirs = context.Pipe()
        self._total = context.Value("q", -1)
        self._process = context.Process(target=_receive, args=(address, theirs, self._total), daemon=True)
        self._process.start()

    def wait_started(self) -> None:
        """Return when the camera streams to the receiver."""
        if not self._mine.poll(30.0) or self._mine.recv() != "started":
            raise BenchFailed("the receiver did not start")

    def finish(self, total: int) -> Reception:
        """Return the reception, once it has `total` events."""
        self._total.value = total
        if not self._mine.poll(60.0):
            raise BenchFailed("the receiver did not get all events within a minute")
        reception: Reception = self._mine.recv()
        self._process.join(10.0)
        return reception


def _receive(address: str, control: Connection, total: Any) -> None:
    host, _, port = address.rpartition(":")
    camera = DavisHost(UsbipHost.attach(host, int(port), "1-1", timeout_s=10.0))
    started = False

    def goes_on(now: Reception) -> bool:
        nonlocal started
        if not started:
            control.send("started")
            started = True
        wanted: int = total.value
        return wanted < 0 or now.events < wanted

    control.send(receive(camera, goes_on, MonotonicClock()))
    camera.close()


def usbip_events() -> float:
    """Mev/s sustained for 10 s from the ring to the decoded event, every event compared by digest.

    The stream is a saturated read-out's (12.5 events a microsecond, eight from each row), pushed as fast as the link
    takes it.
    """
    clock = MonotonicClock()
    camera = partial(Davis346, Davis346Settings(start_delay_us=0))
    setup = LinkSetup("bench", EventRing(), camera, UsbipFactory(UsbipLink(port=0)))
    link = LinkProcess(setup, clock)
    link.wait_ready()
    receiver = _Receiver(link.report.address or "")
    receiver.wait_started()
    block = saturated_stream(_BLOCK)
    span_us = int(block["t"][-1]) + 1
    pushed, start_ns = 0, clock.now_ns()
    link.start(FREE_RUNNING)
    while clock.now_ns() - start_ns < _SUSTAINED_S * 1e9:
        link.push_all(block, int(block["t"][-1]))
        block["t"] += span_us
        pushed += _BLOCK
    reception = receiver.finish(pushed)
    seconds = (clock.now_ns() - start_ns) * 1e-9
    _check(pushed, reception, link.stop(1.0))
    return pushed / seconds * 1e-6


def _check(pushed: int, reception: Reception, report: LinkReport) -> None:
    if report.delivered != pushed or report.dropped or report.dropped_in_device:
        raise BenchFailed(f"{pushed} events pushed, {report}")
    if (reception.events, reception.digest, reception.faults) != (pushed, report.digest, 0):
        raise BenchFailed(f"sent {pushed} events with digest {report.digest:08x}, received {reception}")


def latency_p50() -> float:
    """Median time from an event's own time to its bytes leaving, us, at some 1.5 Mev/s and 1 kHz steps, paced."""
    return _latency().p50 or 0.0


def latency_p99() -> float:
    """99th percentile of the same."""
    return _latency().p99 or 0.0


def latency_p999() -> float:
    """99.9th percentile of the same."""
    return _latency().p999 or 0.0


def late_steps() -> float:
    """Steps of the same run that were ready after their first event was due."""
    return float(_ten_seconds().lateness.frames_late)


def _latency() -> LatencySummary:
    (report,) = _ten_seconds().links.values()
    return report.latency


@functools.cache
def _ten_seconds() -> RunResult:
    return paced_run(_SUSTAINED_S)


def paced_run(seconds: float) -> RunResult:
    """Run the checkerboard in real time with a receiver attached, at a speed that gives about 1.5 Mev/s.

    Raises BenchFailed if the rate is another one, or an event was dropped.
    """
    rig = load_rig("checkerboard")
    if not isinstance(rig.scene, CheckerboardParameters):
        raise TypeError("the shipped checkerboard rig has no checkerboard")
    scene_parameters = dataclasses.replace(rig.scene, speed_px_s=_LATENCY_SPEED_PX_S)
    run = dataclasses.replace(rig.run, step_us=_LATENCY_STEP_US)
    rig = dataclasses.replace(rig, scene=scene_parameters, run=run, links=(UsbipLink(port=0),))
    plan = dataclasses.replace(schedule(rig), duration_ns=round(seconds * 1e9))
    receivers: list[_Receiver] = []

    def attach(now: RunStatus) -> None:
        address = now.links["usbip"].address
        if not receivers and address is not None:
            receivers.append(_Receiver(address))

    with build_scene(rig) as scene:
        session = build_session(rig, scene, link_setups(rig), MonotonicClock())
        result = session.run(plan, attach)
    _check_paced(result)
    return result


def _check_paced(result: RunResult) -> None:
    (report,) = result.links.values()
    rate = report.delivered / result.sim_seconds * 1e-6
    if not 0.5 < rate < 2.0 or report.dropped or report.camera is None or report.camera.dropped_fifo:
        raise BenchFailed(f"{rate:.2f} Mev/s delivered, {report}")


_BAUD = 3_000_000
_LINE_FILLED_S = 10.0
_LINE_STREAM_S = 0.5
_COMPUTER_S = 60.0


def serial_fill() -> float:
    """Percent of 300 kB/s that arrive over 10 s, at 1 us tick, from a sparse sky that gives more than the line carries.

    Fails unless every event and every byte arrives as it was sent.
    """
    clock = MonotonicClock()
    instrument = partial(Instrument, SIZE, InstrumentSettings(housekeeping_s=0))
    setup = LinkSetup("bench", EventRing(), instrument, SerialFactory(SerialLink(baud=_BAUD)))
    link = LinkProcess(setup, clock)
    link.wait_ready()
    computer = _Computer(link.report.address or "")
    while "waiting" in link.listen().state:
        clock.sleep_until(clock.now_ns() + 10_000_000)
    block, offset_us = stars(_LINE_STREAM_S), 0
    start_ns = clock.now_ns()
    link.start(FREE_RUNNING)
    while clock.now_ns() - start_ns < _LINE_FILLED_S * 1e9:
        events = block.copy()
        events["t"] += offset_us
        offset_us += round(_LINE_STREAM_S * 1e6)
        link.push_all(events, offset_us, lambda: clock.now_ns() - start_ns < _LINE_FILLED_S * 1e9)
    filled = link.listen()
    report = link.stop(0.0)
    _check_line(report, computer.finish())
    return 100 * (filled.use.share if filled.use else 0.0)


def _check_line(report: LinkReport, received: InstrumentReception) -> None:
    if received.faults or received.digest != report.digest or received.events != report.delivered:
        raise BenchFailed(f"sent {report.delivered} events with digest {report.digest:08x}, received {received}")
    if report.use is None or report.use.carried != received.counts["bytes"]:
        raise BenchFailed(f"sent {report.use}, received {received.counts['bytes']} bytes")


class _Computer:
    """A reader in a process of its own, until the line is closed."""

    def __init__(self, address: str) -> None:
        context = multiprocessing.get_context("spawn")
        self._mine, theirs = context.Pipe()
        self._process = context.Process(target=_listen, args=(address, theirs), daemon=True)
        self._process.start()

    def finish(self) -> InstrumentReception:
        """Return the reception."""
        if not self._mine.poll(_COMPUTER_S):
            raise BenchFailed("the computer did not report what it received")
        received: Any = self._mine.recv()
        self._process.join(10.0)
        if not isinstance(received, InstrumentReception):
            raise BenchFailed(f"the computer received nothing: {received}")
        return received


def _listen(address: str, control: Connection) -> None:
    try:
        control.send(listen_serial(SerialLink(port=address, baud=_BAUD), lambda _: True, MonotonicClock()))
    except OSError as error:
        control.send(str(error))


FAERY = importlib.util.find_spec("faery") is not None
"""False: the library that writes AEDAT 4.0 is not installed."""

_FILE_EVENTS, _FILE_BLOCK = 10_000_000, 1 << 16
_SUFFIXES = {"aedat4": ".aedat4", "evt3": ".raw"}


@dataclass(frozen=True)
class FileEvents:
    """Mev/s of a saturated read-out from the ring to the whole file."""

    form: Literal["aedat4", "evt3"]

    def __call__(self) -> float:
        """Measure, and compare every event."""
        clock, sent = MonotonicClock(), saturated_stream(_FILE_EVENTS)
        with TemporaryFolder("bench") as folder:
            path = Path(folder, f"events{_SUFFIXES[self.form]}")
            text = f'[scene]\nkind = "checkerboard"\n[[links]]\nkind = "file"\npath = "{path}"\n'
            (setup,) = link_setups(parse_rig(text, "bench.toml", "bench"))
            link = LinkProcess(setup, clock)
            link.wait_ready()
            start_ns = clock.now_ns()
            link.start(FREE_RUNNING)
            for start in range(0, _FILE_EVENTS, _FILE_BLOCK):
                part = sent[start : start + _FILE_BLOCK]
                link.push_all(part, int(part["t"][-1]))
            report = link.stop(_COMPUTER_S)
            seconds = (clock.now_ns() - start_ns) * 1e-9
            back = read_events(path)
        back["t"] += sent["t"][0] - back["t"][0]  # of AEDAT 4.0 they are Unix time
        if report.error is not None or not np.array_equal(back, sent):
            raise BenchFailed(f"of {len(sent)} events the file holds {len(back)}, or others; {report}")
        return len(sent) / seconds * 1e-6
