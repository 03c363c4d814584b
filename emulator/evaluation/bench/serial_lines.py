"""A 3 Mbaud line over a pty, filled for 10 s: the share of its capacity that arrives, every event compared.

Three processes, as in a run: this one feeds the ring; the link's own process holds the instrument and keeps the baud
rate; a computer opens the pty, decodes every block and digests every event.
"""

from __future__ import annotations

import multiprocessing
from functools import partial
from multiprocessing.connection import Connection
from typing import Any

from emulator.evaluation.bench.streams import SIZE, BenchFailed, stars
from emulator.run.link_process import LinkProcess
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup
from transports.link.reception import InstrumentReception
from transports.link.report import LinkReport
from transports.link.rings import FREE_RUNNING, EventRing
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.kind import SerialLink
from transports.serial_line.port import listen_serial

__all__ = ["serial_fill"]

_BAUD = 3_000_000
_FILLED_S = 10.0
_STREAM_S = 0.5
_PATIENCE_S = 60.0


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
    block, offset_us = stars(_STREAM_S), 0
    start_ns = clock.now_ns()
    link.start(FREE_RUNNING)
    while clock.now_ns() - start_ns < _FILLED_S * 1e9:
        events = block.copy()
        events["t"] += offset_us
        offset_us += round(_STREAM_S * 1e6)
        link.push_all(events, offset_us, lambda: clock.now_ns() - start_ns < _FILLED_S * 1e9)
    filled = link.listen()
    report = link.stop(0.0)
    _check(report, computer.finish())
    return 100 * (filled.use.share if filled.use else 0.0)


def _check(report: LinkReport, received: InstrumentReception) -> None:
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
        if not self._mine.poll(_PATIENCE_S):
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
