"""Events, frames, inertial samples and edges of a free-running DAVIS346 through the wraps of its time, all compared.

The run is `evstim run` with pace "free"; its reader is evstim's USB/IP host and `word_reader`, which shares nothing
with the package. What must come is arithmetic alone: events follow the recording (see `looped`), edges the trigger's
period, samples the clock of the inertial unit, frames the interval that the host has written. Frames are small and
rare, samples a few a second, so that a day takes minutes.
"""

from __future__ import annotations

import struct
import tempfile
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.usb.device import SetupPacket
from tests.hostile.looped import Follower, Looped
from tests.hostile.test_usbip_soak import FreeRun
from tests.hostile.word_reader import EXPOSURE_END, EXPOSURE_START, FALLING, RISING, WordReader
from transports.usb.usbip.client import UsbipHost

TABLES = """
[camera.frames]
[camera.imu]
clock_ppm = 0.0
[trigger]
period_ms = 1000.0
pulse_us = 100
"""
GAP_US, LOOP = 20_000, 50_000
EXPOSURE_US, INTERVAL_US, ADC_MHZ = 1_000_000, 8_000_000, 30
REGION = 100, 50, 107, 59
DIVIDER = 200
STOP = [(1, 3, 0), (2, 4, 0), (3, 2, 0), (3, 3, 0), (3, 4, 0), (4, 0, 0), (0, 0, 0), (0, 1, 0), (9, 0, 0), (0, 3, 0)]
SETTINGS = [
    *((2, 8 + k, value) for k, value in enumerate(REGION)),
    (2, 12, EXPOSURE_US * ADC_MHZ), (2, 13, INTERVAL_US * ADC_MHZ),
    (3, 5, DIVIDER - 1), (4, 1, 1), (4, 2, 1), (4, 3, 0),
]  # fmt: skip
RUN = [(0, 3, 1), (9, 0, 1), (0, 1, 1), (0, 0, 1), (1, 3, 1), (2, 4, 1), (3, 2, 1), (3, 3, 1), (3, 4, 1), (4, 0, 1)]
RESET = [(0, 2, 1), (0, 2, 0)]


@dataclass
class Seen:
    """How many of each stream came, and the device time reached."""

    events: int = 0
    edges: int = 0
    samples: int = 0
    frames: int = 0
    device_us: int = 0


class StreamSoak:
    """Reads one run and compares everything as it comes; raises AssertionError at the first difference."""

    def __init__(self, looped):
        self.seen = Seen()
        self._reader, self._follower = WordReader(), Follower(looped)
        self._first_us = {}

    @property
    def since_first_us(self):
        """Device time since each stream has begun; the run learns what its host wants after a while of wall time."""
        first_us = [self._first_us.get(name, self.seen.device_us) for name in ("frames", "samples", "edges")]
        return self.seen.device_us - max(first_us)

    def take(self, data):
        """Compare what a transfer holds."""
        self._follower.take(self._reader.feed(data))
        reader = self._reader
        for t_us, code in _drained(reader.edges):
            self._edge(t_us, code)
        for t_us, scale, counts in _drained(reader.samples):
            self._on_grid("samples", t_us, DIVIDER * 1000)
            assert (scale, len(counts)) == (0xE5, 14)
        for frame in _drained(reader.frames):
            self._frame(frame)
        self.seen.events, self.seen.device_us = self._follower.seen, max(0, reader.time_us)

    def _edge(self, t_us, code):
        """Edges rise each second and fall 100 us later."""
        rising = self.seen.edges % 2 == 0 if self._first_us.setdefault("code", code) == RISING else self.seen.edges % 2
        assert code == (RISING if rising else FALLING)
        first_us = self._first_us.setdefault("edges", t_us - (0 if code == RISING else 100))
        rises, _ = divmod(t_us - first_us + 500_000, 1_000_000)
        assert t_us == first_us + rises * 1_000_000 + (0 if rising else 100)
        assert self.seen.edges in (2 * rises + (not rising), 2 * rises + (not rising) - 1)
        self.seen.edges += 1

    def _on_grid(self, name, t_us, period_us):
        """The k-th of a stream comes k periods after its first."""
        count = getattr(self.seen, name)
        first_us = self._first_us.setdefault(name, t_us)
        assert t_us == first_us + count * period_us, (name, t_us, first_us, count)
        setattr(self.seen, name, count + 1)

    def _frame(self, frame):
        self._on_grid("frames", frame.start_us, INTERVAL_US)
        assert frame.exposure_cycles == EXPOSURE_US * ADC_MHZ
        assert frame.exposure_us[EXPOSURE_END] - frame.exposure_us[EXPOSURE_START] == EXPOSURE_US
        assert [high << 8 | low for high, low in zip(*[iter(frame.bytes)] * 2, strict=True)] == list(REGION)
        left, top, right, bottom = REGION
        columns, rows = right - left + 1, bottom - top + 1
        assert [len(samples) for _, samples in frame.lines] == [rows] * (2 * columns)
        assert [kind for kind, _ in frame.lines] == [11] * columns + [12] * columns


def _drained(kept):
    """Return what a list holds, and empty it."""
    held, kept[:] = kept[:], []
    return held


def write(host, entries):
    """Write several registers with one request."""
    data = b"".join(struct.pack(">BBI", *entry) for entry in entries)
    host.control_out(SetupPacket(0x40, 0xC2, len(entries), 0, len(data)), data)


def soak(hours):
    """Read so much device time; return what came and the run's summary."""
    looped = Looped(LOOP, GAP_US)
    soaking = StreamSoak(looped)
    with tempfile.TemporaryDirectory() as folder:
        run = FreeRun(looped, Path(folder), tables=TABLES)
        try:
            host = UsbipHost.attach(port=run.port, timeout_s=120.0)
            host.configure()
            write(host, STOP + SETTINGS)
            stream = host.stream(2, 131_072, 32)
            write(host, RUN)
            write(host, RESET)
            while soaking.since_first_us < hours * 3.6e9:
                data = stream.read(120.0)
                assert data is not None, f"no data for two minutes after {soaking.seen}"
                soaking.take(data)
            write(host, STOP)
            host.close()
            return soaking.seen, run.stop()
        finally:
            run.close()
