"""A DAVIS346 whose host writes anything to its registers while events, frames, samples and edges come.

The registers are written one by one or many at once, with 0, all ones and random values; a part of the writes go to
registers that can only be read or do not exist. Beside them the host flushes, asks for a log level, and sends requests
that are refused. After each batch the run bits are set in two cases of three, and in half of these all filters, regions
and times of frames are those at power-on; then time goes on: what the host decodes
must be what the camera says that it has delivered, the ledgers balance, and every register reads back as the published
logic keeps it. In the end a host sets all registers to their power-on values, starts the camera as drivers do, and must
read every event, frame, sample and edge.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from emulator.light import LightFrame
from emulator.run.imu import EARTH_IN_THE_PICTURE, Carried, ImuSource, ImuUnit
from emulator.sensor.frames import FrameSource
from emulator.sensor.parameters import FrameParameters, ImuParameters
from emulator.trajectory.pose import Fixed, Timescale
from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.registers import Layout, registers
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import EdgeKind, make_edges
from firmware_protocol.frames import LineKind
from firmware_protocol.fx3.registers import Access, SystemInfo
from firmware_protocol.usb.device import Stall
from tests.firmware_protocol.davis_host import OUT, RUN, SENSORS, STOP, Host, steady
from tests.firmware_protocol.davis_registers import kept

__all__ = ["Campaign", "Counts"]

SIZE = (346, 260)
DECLARED = list(registers(SIZE, Layout.UPRIGHT, SystemInfo(), imu_unit=2))
KEYS = [(int(one.module), one.address) for one in DECLARED]
WRITABLE = {(int(one.module), one.address): one.default for one in DECLARED if one.access is Access.READ_WRITE}
FIXED = {(int(one.module), one.address): one.default for one in DECLARED if one.access is Access.READ_ONLY}
COUNTERS = {(0, k) for k in range(81, 85)} | {(1, k) for k in range(81, 93)}
ABSENT = [(0, 6), (1, 100), (3, 8), (5, 127), (6, 8), (7, 0), (9, 2), (255, 255)]
TIMESTAMP_RUN = 0, 1
FRAMES, IMU = ReadingKind.FRAMES, ReadingKind.IMU


@dataclass
class Counts:
    """What has happened so far."""

    writes: int = 0
    refused: int = 0
    events: int = 0
    frames: int = 0
    samples: int = 0
    edges: int = 0
    batches_streaming: int = 0


@dataclass
class _FrameInTransit:
    """The lines of a frame that the camera says have left."""

    lines: list[np.ndarray] = field(default_factory=list)

    def take(self, record):
        """Take a line, (1,) of `line_record`; return all lines of a frame that is whole with it."""
        if int(record["kind"][0]) == LineKind.START:
            self.lines = []
        self.lines.append(record)
        if int(record["kind"][0]) != LineKind.END:
            return None
        frame, self.lines = np.concatenate(self.lines), []
        left, _, right, _ = frame["roi"][0].tolist()
        whole = frame["kind"][0] == LineKind.START and len(frame) == 2 * (right - left + 1) + 4
        return frame if whole else None


class Campaign:
    """A camera, its sensor's parts, and a host that knows no manners."""

    def __init__(self, seed):
        self.camera = Davis346(Davis346Settings(frames=True, imu_unit=2, start_delay_us=50))
        self.host = Host(self.camera)
        self.counts = Counts()
        self._draw = np.random.default_rng(seed)
        self._expected = dict(WRITABLE)
        self._light = np.linspace(0.2, 1.0, SIZE[0] * SIZE[1], dtype=np.float32).reshape(SIZE[::-1])
        unit = ImuUnit(ImuParameters(), Carried(Fixed(), EARTH_IN_THE_PICTURE, Timescale()), seed)
        self._sources = (FrameSource(FrameParameters(), seed, SIZE), ImuSource(unit))
        for source in self._sources:
            source.reset(LightFrame(0, self._light))
        self._transit = _FrameInTransit()
        self._epoch_us = 0

    # --- the host

    def batch(self, count):
        """Write `count` registers, send other requests, let time pass and read."""
        writes = [self._any_write() for _ in range(count)]
        setting = self._draw.random()
        if setting < 1 / 3:
            writes += [(*key, WRITABLE[key]) for key in WRITABLE if key[0] in (1, 2)]
        if setting < 2 / 3:
            writes += RUN + SENSORS
        if self._draw.random() < 0.5:
            self.host.multi_write(writes)
        else:
            self.host.write_all(writes)
        for write in writes:
            self._expect(*write)
        self.counts.writes += count
        self._any_requests()
        self._read_back(writes)
        self.step(int(self._draw.choice([50, 2000, 40_000, 40_000])), reads=self._draw.random() < 0.9)

    def _any_write(self):
        kinds = (0, 0xFFFFFFFF, int(self._draw.integers(1 << 32)), int(self._draw.integers(512)))
        keys = KEYS if self._draw.random() < 0.98 else ABSENT
        return (*keys[int(self._draw.integers(len(keys)))], kinds[int(self._draw.integers(4))])

    def _expect(self, module, address, value):
        """Note what the register must read now; a reader of the stream begins anew where time does."""
        key = module, address
        if key not in WRITABLE:
            return
        before, self._expected[key] = self._expected[key], kept(module, address, value)
        if key == TIMESTAMP_RUN and self._expected[key] > before:
            self.host.decoder, self._transit = Decoder(SIZE), _FrameInTransit()

    def _any_requests(self):
        wrong = ((0xBF, 0, 0, b"\0"), (0xC2, 3, 0, b"\0" * 6), (0xB9, 0, 0, b""), (0xBE, 1, 0, b"\0" * 64))
        for request in ((0xC6, 0, 0, b""), (0xB1, 4, 0, b""), *wrong):
            if self._draw.random() < 0.1:
                try:
                    self.host.control(OUT, *request)
                except Stall:
                    self.counts.refused += 1
                    assert request in wrong, request

    def _read_back(self, writes):
        """Every register that was written, and every one in one case of fifty."""
        asked = {(module, address) for module, address, _ in writes}
        for key in KEYS + ABSENT if self._draw.random() < 0.02 else asked:
            if key not in COUNTERS:
                expected = self._expected.get(key, FIXED.get(key, 0))
                assert self.host.read(*key) == expected, (key, self.host.read(*key), expected)

    # --- what the camera sees and sends

    def step(self, step_us, *, reads=True):
        """Let time pass with everything going on; return the events and edges that were offered."""
        now_us = self.camera.now_us
        until_us = now_us + step_us
        for source in self._sources:
            settings = self.camera.reading_settings(source.kind)
            self.camera.offer_readings(source.kind, source.read(LightFrame(until_us * 1000, self._light), settings))
        edges = make_edges(
            np.linspace(now_us + 1, until_us, 4).astype(np.uint64),
            (EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.RISING, EdgeKind.FALLING),
        )
        self.camera.offer_edges(edges)
        events = steady(25, now_us + 1, max(1, step_us // 26), int(self._draw.integers(1000)))
        self.camera.offer(events)
        self.camera.advance(until_us)
        self.counts.batches_streaming += self.camera.streaming
        if reads:
            self.read()
        self.check_ledgers()
        return events, edges

    def read(self):
        """Read all there is; what is decoded must be what the camera says."""
        while (transfer := self.camera.read(2, int(self._draw.choice([62, 512, 8192, 131072])))) is not None:
            self.camera.sent(transfer)
            if transfer.epoch_us != self._epoch_us:
                self._epoch_us, self._transit = transfer.epoch_us, _FrameInTransit()
            decoded = self.host.decoder.feed(transfer.data)
            told = np.concatenate([one.record for one in transfer.readings if one.kind is IMU] or [decoded.imu[:0]])
            for seen, said in ((decoded.events, transfer.events), (decoded.edges, transfer.edges), (decoded.imu, told)):
                seen["t"] += np.uint64(transfer.epoch_us)
                assert np.array_equal(seen, said)
            self._check_frames(decoded.frames, [one.record for one in transfer.readings if one.kind is FRAMES])
            self.counts.events += len(decoded.events)
            self.counts.edges += len(decoded.edges)
            self.counts.samples += len(told)
        assert self.host.decoder.faults.total == 0, self.host.decoder.faults

    def _check_frames(self, seen, lines):
        whole = [frame for frame in map(self._transit.take, lines) if frame is not None]
        assert len(seen) == len(whole)
        for read, told in zip(seen, whole, strict=True):
            head, end_us = told[0], int(told["t"][-1]) - self._epoch_us
            assert (read.exposure_cycles, read.end_us) == (int(head["exposure"]), end_us)
            assert read.roi == tuple(head["roi"].tolist())
            for kind, got in ((LineKind.RESET, read.reset), (LineKind.SIGNAL, read.signal)):
                assert np.array_equal(told[told["kind"] == kind]["samples"][:, : got.shape[0]].T, got)
        self.counts.frames += len(seen)

    def check_ledgers(self):
        """Everything that was offered has exactly one fate, and the sensor's figures stay figures."""
        counters = self.camera.counters
        assert counters.offered == counters.accounted, counters
        assert counters.edges.accounted == counters.edges.offered + counters.edges.added, counters.edges
        for one in counters.readings.values():
            assert one.offered == one.accounted, counters.readings
        assert all(0.1 <= factor <= 1000 for factor in self.camera.sensor_factors.values())

    # --- afterwards

    def assert_exact_again(self, steps=120):
        """Start the camera as drivers do; it must then send everything that comes in `steps` of 1 ms, and no more."""
        self.start_anew()
        dropped = self.camera.counters.dropped_fifo
        offered = [self.step(1000) for _ in range(steps)]
        self.read()
        assert self.counts.events == sum(len(events) for events, _ in offered)
        assert self.counts.edges == sum(len(edges) for _, edges in offered)
        assert abs(self.counts.samples - steps) <= 1
        assert self.counts.frames == steps // 40
        assert self.camera.counters.dropped_fifo == dropped
        assert self.host.decoder._frames.incomplete == 0

    def start_anew(self):
        """Do what drivers do when they open a camera in any state."""
        self.host.write_all(STOP)
        self.step(10_000)  # as libcaer waits; the sensor's parts hear of registers once a step
        self.host.multi_write([(*key, value) for key, value in WRITABLE.items()])
        self.host.write_all([(2, 12, 3000 * 30), (2, 13, 40_000 * 30), (4, 1, 1), (4, 2, 1), (4, 3, 0)])
        self.host.write_all(RUN + SENSORS)
        self._expected = {key: self.host.read(*key) for key in WRITABLE}
        self.host.decoder, self._transit = Decoder(SIZE), _FrameInTransit()
        self.step(1000)  # through the silence after the start
        self.counts = Counts()
