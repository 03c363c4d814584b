"""A camera's whole life, told at random: every event, edge and sample has exactly one fate, and readers agree."""

import dataclasses

import numpy as np
from davis_host import OUT
from davis_strategies import STEPS_US
from dvxplorer_host import MEASURE, RUN, Host, scattered
from hypothesis import settings, stateful
from hypothesis import strategies as st

from firmware_protocol.device.items import ReadingKind
from firmware_protocol.dvxplorer import Dvxplorer, DvxplorerSettings, GroupDecoder
from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.imu_samples import no_samples

IMU = ReadingKind.IMU
CHIP = [0x0B, 0x12, 0x1C, 0x1E, 0x3000, 0x3067, 0x3200, 0x3204, 0x3206, 0x3300, 0x3302, 0x3303, 0x3307, 0x3262]


class Life(stateful.RuleBasedStateMachine):
    """A camera under any sequence of events, time, requests and reads."""

    def __init__(self):
        super().__init__()
        self.camera = Dvxplorer(DvxplorerSettings(fifo_bytes=1024, start_delay_us=100, imu_unit=3))
        self.host = Host(self.camera)
        self.host.write_all([*RUN, *MEASURE])
        self.open = []
        self.t_us = 0

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=20), scale=st.sampled_from([0x20, 0xEA, 0x83]))
    def offer_samples(self, steps, scale):
        samples = no_samples(len(steps))
        samples["t"], samples["scale"] = self.t_us + np.cumsum(steps), scale
        samples["counts"][:, 3] = np.arange(len(steps)) if scale & 0x20 else 0
        self.camera.offer_readings(IMU, samples)

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=8), repeat=st.integers(1, 40), seed=st.integers(0, 9))
    def offer(self, steps, repeat, seed):
        events = scattered(len(steps) * repeat, seed=seed)
        events["t"] = self.t_us + np.cumsum(np.tile(steps, repeat))
        events["x"] %= np.uint16(3)
        self.camera.offer(events.astype(EVENT))
        self.t_us = int(events["t"][-1])

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=4), back_us=STEPS_US, kinds=st.integers(0, 80))
    def offer_edges(self, steps, back_us, kinds):
        edges = np.zeros(len(steps), EDGE)
        edges["t"] = max(0, self.t_us - back_us) + np.cumsum(steps)
        edges["kind"] = [2 + kinds // 3**k % 3 for k in range(len(steps))]
        self.camera.offer_edges(edges)

    @stateful.rule(bits=st.integers(0, 127))
    def detect(self, bits):
        self.host.write_all([(4, k, bits >> k & 1) for k in range(4)])
        self.host.write_all([(4, 13, 104 * 700), (4, 14, 104 * 300), (4, 15, 1), (4, 16, 1), (4, 11, bits >> 4 & 1)])
        self.host.write_all([(4, 5, 104 * 20), (0, 4, bits >> 5 & 1)])

    @stateful.rule(address=st.sampled_from(CHIP), value=st.sampled_from([0, 1, 2, 0x10, 0x80, 255, 0xFFFFFFFF]))
    def write_chip(self, address, value):
        self.host.write(5, address, value)

    @stateful.rule(step_us=STEPS_US)
    def advance(self, step_us):
        self.t_us += step_us
        self.camera.advance(self.t_us)

    @stateful.rule(max_bytes=st.sampled_from([2, 5, 64, 512, 4096]), times=st.integers(1, 4), good=st.booleans())
    def read(self, max_bytes, times, good):
        for transfer in self.open:
            (self.camera.sent if good else self.camera.lost)(transfer)
        self.open = []
        for _ in range(times):
            transfer = self.camera.read(2, max_bytes)
            if transfer is None:
                return
            decoded = self.host.decoder.feed(transfer.data)
            told = np.concatenate([no_samples(), *[one.record for one in transfer.readings]])
            for seen, said in ((decoded.events, transfer.events), (decoded.edges, transfer.edges), (decoded.imu, told)):
                seen["t"] += np.uint64(transfer.epoch_us)
                assert np.array_equal(seen, said)
            self.open.append(transfer)

    @stateful.rule()
    def reset(self):
        self.host.reset_timestamps()

    @stateful.rule()
    def flush(self):
        self.host.control(OUT, 0xC6, 0, 0)

    @stateful.rule(bit=st.sampled_from([entry[:2] for entry in RUN]), again=st.booleans())
    def switch_off(self, bit, again):
        self.host.write(*bit, 0)
        if again:
            self.run()

    @stateful.rule(again=st.booleans())
    def unplug(self, again):
        self.camera.detached()
        self.host = Host(self.camera)
        if again:
            self.run()

    @stateful.rule()
    def run(self):
        if not self.host.read(0, 1):
            self.host.decoder = GroupDecoder()
        self.host.write_all(RUN)

    @stateful.invariant()
    def everything_has_one_fate(self):
        counters = self.camera.counters
        assert counters.balanced
        assert counters.edges.balanced
        for one in (counters.edges, *counters.readings.values()):
            assert one.balanced
            assert min(dataclasses.astuple(one)) >= 0
        assert min(dataclasses.astuple(counters)[:-2]) >= 0

    @stateful.invariant()
    def the_host_finds_no_fault(self):
        assert self.host.decoder.faults.total == 0


Life.TestCase.settings = settings(stateful_step_count=40)
test_any_life_of_a_camera_balances = Life.TestCase
