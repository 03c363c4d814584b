"""A camera's whole life, told at random: every event, edge, frame line and sample has exactly one fate."""

import dataclasses

import numpy as np
from davis_host import OUT, RUN, Host
from davis_strategies import STEPS_US
from hypothesis import settings, stateful
from hypothesis import strategies as st

from firmware_protocol.davis346 import Davis346, Davis346Settings
from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.frames import LineKind, line_record
from firmware_protocol.imu_samples import no_samples

FRAMES, IMU = ReadingKind.FRAMES, ReadingKind.IMU
STREAMS = [(1, 3), (2, 4), (3, 2), (3, 3), (3, 4), (4, 0)]
FRAME_KINDS = [LineKind.START, *[LineKind.RESET] * 3, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
FRAME_KINDS += [*[LineKind.SIGNAL] * 3, LineKind.END]


def frame(number, start_us, line_us):
    """A frame of 3 columns and 2 rows whose samples and exposure tell its number."""
    lines = np.zeros(len(FRAME_KINDS), line_record(346))
    lines["t"], lines["kind"] = start_us + line_us * np.arange(len(FRAME_KINDS)), FRAME_KINDS
    lines["exposure"], lines["roi"], lines["length"] = number, (4, 5, 6, 6), 2
    lines["samples"][:, :2] = number % 1024
    return lines


WORDS = st.sampled_from([0, 1, 255, 0xFFFFFFFF])


class Life(stateful.RuleBasedStateMachine):
    """A camera under any sequence of events, time, requests and reads.

    Counters must balance at any time, and what a host decodes must be what each transfer says it completes.
    """

    def __init__(self):
        super().__init__()
        self.camera = Davis346(Davis346Settings(fifo_bytes=1024, start_delay_us=100, frames=True, imu_unit=1))
        self.host = Host(self.camera)
        self.host.write_all(RUN)
        self.open = []
        self.t_us = 0
        self.frames = 0

    @stateful.rule(line_us=STEPS_US)
    def offer_frame(self, line_us):
        self.frames += 1
        self.camera.offer_readings(FRAMES, frame(self.frames, self.t_us + 1, line_us))

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=20), scale=st.sampled_from([0x20, 0xE5, 0x83]))
    def offer_samples(self, steps, scale):
        samples = no_samples(len(steps))
        samples["t"], samples["scale"] = self.t_us + np.cumsum(steps), scale
        samples["counts"][:, 3] = np.arange(len(steps)) if scale & 0x20 else 0
        self.camera.offer_readings(IMU, samples)

    @stateful.rule(stream=st.sampled_from(STREAMS), on=st.booleans())
    def switch_stream(self, stream, on):
        self.host.write(*stream, int(on))

    @stateful.rule(
        key=st.sampled_from([(0, 4), (2, 5), (2, 7), (2, 12), (3, 5), (1, 41), (1, 52), (5, 11)]), value=WORDS
    )
    def write_any(self, key, value):
        self.host.write(*key, value)

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=8), repeat=st.integers(1, 40), seed=st.integers(0, 9))
    def offer(self, steps, repeat, seed):
        events = np.zeros(len(steps) * repeat, EVENT)
        events["t"] = self.t_us + np.cumsum(np.tile(steps, repeat))
        rng = np.random.default_rng(seed)
        events["x"], events["y"] = rng.integers(0, 346, len(events)), rng.integers(0, 3, len(events))
        self.camera.offer(events)
        self.t_us = int(events["t"][-1])

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=4), back_us=STEPS_US, kinds=st.integers(0, 80))
    def offer_edges(self, steps, back_us, kinds):
        edges = np.zeros(len(steps), EDGE)
        edges["t"] = max(0, self.t_us - back_us) + np.cumsum(steps)
        edges["kind"] = [2 + kinds // 3**k % 3 for k in range(len(steps))]
        self.camera.offer_edges(edges)

    @stateful.rule(bits=st.integers(0, 127))
    def listen(self, bits):
        """Any selection of the detector, of the generator's edges, and of what a stall drops."""
        self.host.write_all([(4, k, bits >> k & 1) for k in range(4)])
        self.host.write_all([(4, 13, 104 * 700), (4, 14, 104 * 300), (4, 15, 1), (4, 16, 1), (4, 11, bits >> 4 & 1)])
        self.host.write_all([(4, 5, 104 * 20), (0, 4, bits >> 5 & 1)])

    @stateful.rule(step_us=STEPS_US)
    def advance(self, step_us):
        self.t_us += step_us
        self.camera.advance(self.t_us)

    @stateful.rule(max_bytes=st.sampled_from([2, 5, 64, 512, 4096]), times=st.integers(1, 4), good=st.booleans())
    def read(self, max_bytes, times, good):
        self.settle(good)
        for _ in range(times):
            transfer = self.camera.read(2, max_bytes)
            if transfer is None:
                return
            decoded = self.host.decoder.feed(transfer.data)
            samples = [one.record for one in transfer.readings if one.kind is IMU]
            told = np.concatenate([no_samples(), *samples])
            for seen, said in ((decoded.events, transfer.events), (decoded.edges, transfer.edges), (decoded.imu, told)):
                seen["t"] += np.uint64(transfer.epoch_us)
                assert np.array_equal(seen, said)
            for read in decoded.frames:
                assert set(np.unique([read.reset, read.signal]).tolist()) == {read.exposure_cycles % 1024}
            self.open.append(transfer)

    def settle(self, good):
        for transfer in self.open:
            (self.camera.sent if good else self.camera.lost)(transfer)
        self.open = []

    @stateful.rule()
    def reset(self):
        self.host.reset_timestamps()

    @stateful.rule()
    def flush(self):
        self.host.control(OUT, 0xC6, 0, 0)

    @stateful.rule(bit=st.sampled_from([(m, p) for m, p, _ in RUN]), again=st.integers(0, 3))
    def switch_off(self, bit, again):
        self.host.write(*bit, 0)
        if again:
            self.run()

    @stateful.rule(again=st.integers(0, 3))
    def unplug(self, again):
        self.camera.detached()
        self.host = Host(self.camera)
        if again:
            self.run()

    @stateful.rule()
    def run(self):
        if not self.host.read(0, 1):
            self.host.decoder = Decoder((346, 260))
        self.host.write_all(RUN)

    @stateful.invariant()
    def every_event_has_one_fate(self):
        assert self.camera.counters.offered == self.camera.counters.accounted
        edges = self.camera.counters.edges
        assert edges.accounted == edges.offered + edges.added
        for one in self.camera.counters.readings.values():
            assert one.accounted == one.offered
            assert min(dataclasses.astuple(one)) >= 0
        assert min(dataclasses.astuple(edges)) >= 0
        assert min(dataclasses.astuple(self.camera.counters)[:-2]) >= 0  # the last are edges and readings

    @stateful.invariant()
    def the_host_finds_no_fault(self):
        assert self.host.decoder.faults.total == 0


Life.TestCase.settings = settings(stateful_step_count=40)
test_any_life_of_a_camera_balances = Life.TestCase
