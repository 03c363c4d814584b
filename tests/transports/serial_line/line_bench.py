"""A serial link on a pty with a real reader, on a clock that the test moves."""

import asyncio
import time
from functools import partial

import numpy as np
import serial

from firmware_protocol.events import EVENT
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.receiver.instrument import SerialReceiver
from tests.made_events import steady
from transports.faults.script import FaultPlan
from transports.link.kind import Wiring
from transports.link.pacing import FakeClock
from transports.link.process import Link, LinkSetup
from transports.link.rings import EventRing
from transports.recording.live import FileRecorder
from transports.serial_line.endpoint import SerialFactory
from transports.serial_line.kind import SerialLink

ORIGIN_NS = 1_000_000_000
TICK_NS = 500_000
PATIENCE_S = 120.0


def stream(count, every_us=20, start_us=0):
    return steady(count, start_us, every_us, start_us)


class Bench:
    """A link on a clock that the test moves, and its reader."""

    def __init__(self, record=None, settings=None, faults=None, **line):
        self.clock = FakeClock(ORIGIN_NS)
        self.ring = EventRing(200_000)
        parameters = SerialLink(**{"baud": 3_000_000, **line})
        device = partial(Instrument, (346, 260), settings or InstrumentSettings(housekeeping_s=0))
        self.link = Link(
            LinkSetup(
                "serial",
                self.ring,
                device,
                SerialFactory(parameters, Wiring(faults or FaultPlan())),
                None if record is None else FileRecorder(record),
            ),
            self.clock,
        )
        self.receiver = SerialReceiver(parameters.profile)
        self.port, self.closed = None, False
        self.parts, self.told = [], []

    async def open(self):
        await self.link.endpoint.start()

    def plug(self):
        """Open the reader's side."""
        self.port = serial.Serial(self.link.endpoint.report().address, timeout=0)
        self.link.tick()

    def give(self, events, now_us):
        self.ring.push(events)
        self.ring.publish(now_us)

    def run(self, ticks, read=True):
        """Let ticks pass; the reader reads meanwhile."""
        for _ in range(ticks):
            self.clock.advance(TICK_NS)
            self.link.tick()
            if read:
                self.read()

    def read(self):
        self.receiver.push(self.port.read(1 << 16))
        self.parts.append(self.receiver.take_events())
        self.told += self.receiver.take_reports()

    def read_until(self, count):
        """Read what the kernel still holds: it hands a pty's bytes over in its own time."""
        deadline = time.monotonic() + PATIENCE_S
        while len(self.events) < count:
            assert time.monotonic() < deadline, f"{len(self.events)} of {count} events came"
            self.read()

    def tell(self, command):
        self.port.write(self.receiver.wrap(command))
        before, deadline = len(self.told), time.monotonic() + PATIENCE_S
        while len(self.told) < before + 2:
            assert time.monotonic() < deadline, "no answer"
            self.run(1)
        return self.told[before:]

    def close(self):
        """Unplug, and close the link."""
        if self.port:
            self.port.close()
        asyncio.run(self.link.close())
        self.closed = True

    @property
    def events(self):
        return np.concatenate(self.parts) if self.parts else np.zeros(0, EVENT)
