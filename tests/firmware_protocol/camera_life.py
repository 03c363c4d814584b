"""The whole life of a camera, told at random: what its sensor offers, time, and hosts of iniVation's cameras."""

import dataclasses

import numpy as np
from davis_host import OUT
from davis_strategies import STEPS_US
from hypothesis import stateful
from hypothesis import strategies as st

from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import make_edges
from firmware_protocol.imu_samples import no_samples
from tests.made_events import events_at

IMU = ReadingKind.IMU


class CameraLife(stateful.RuleBasedStateMachine):
    """A camera that is offered events and edges while time passes; its events are within `AREA`."""

    AREA, EDGE_KINDS = (346, 3), 3

    def __init__(self, camera):
        super().__init__()
        self.camera = camera
        self.t_us = 0

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=8), repeat=st.integers(1, 40), seed=st.integers(0, 9))
    def offer(self, steps, repeat, seed):
        events = events_at(self.t_us + np.cumsum(np.tile(steps, repeat)))
        rng = np.random.default_rng(seed)
        events["x"], events["y"], events["on"] = rng.integers(0, (*self.AREA, 2), (len(events), 3)).T
        self.camera.offer(events)
        self.t_us = int(events["t"][-1])

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=4), back_us=STEPS_US, kinds=st.integers(0, 80))
    def offer_edges(self, steps, back_us, kinds):
        edges = make_edges(
            max(0, self.t_us - back_us) + np.cumsum(steps),
            [2 + kinds // 3**k % self.EDGE_KINDS for k in range(len(steps))],
        )
        self.camera.offer_edges(edges)

    @stateful.rule(step_us=STEPS_US)
    def advance(self, step_us):
        self.t_us += step_us
        self.camera.advance(self.t_us)

    @stateful.invariant()
    def everything_has_one_fate(self):
        counters = self.camera.counters
        for one in (counters, counters.edges, *counters.readings.values()):
            assert one.balanced
            assert min(fate for fate in dataclasses.astuple(one) if isinstance(fate, int)) >= 0


class Fx3Life(CameraLife):
    """A camera of iniVation under any sequence of requests and reads.

    What a host decodes must be what each transfer says that it completes.
    """

    RUN, SCALES = [], ()

    def __init__(self, camera):
        super().__init__(camera)
        self.host = self.new_host()
        self.open = []

    def new_host(self):
        raise NotImplementedError

    @stateful.rule(data=st.data(), steps=st.lists(STEPS_US, min_size=1, max_size=20))
    def offer_samples(self, data, steps):
        samples, scale = no_samples(len(steps)), data.draw(st.sampled_from(self.SCALES))
        samples["t"], samples["scale"] = self.t_us + np.cumsum(steps), scale
        samples["counts"][:, 3] = np.arange(len(steps)) if scale & 0x20 else 0
        self.camera.offer_readings(IMU, samples)

    @stateful.rule(bits=st.integers(0, 127))
    def detect(self, bits):
        """Any selection of the detector, of the generator's edges, and of what a stall drops."""
        self.host.write_all([(4, k, bits >> k & 1) for k in range(4)])
        self.host.write_all([(4, 13, 104 * 700), (4, 14, 104 * 300), (4, 15, 1), (4, 16, 1), (4, 11, bits >> 4 & 1)])
        self.host.write_all([(4, 5, 104 * 20), (0, 4, bits >> 5 & 1)])

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
            told = np.concatenate([no_samples(), *(one.record for one in transfer.readings if one.kind is IMU)])
            for seen, said in ((decoded.events, transfer.events), (decoded.edges, transfer.edges), (decoded.imu, told)):
                seen["t"] += np.uint64(transfer.epoch_us)
                assert np.array_equal(seen, said)
            self.check(decoded)
            self.open.append(transfer)

    def check(self, decoded):
        """Check what else a host decodes."""

    @stateful.rule()
    def reset(self):
        self.host.reset_timestamps()

    @stateful.rule()
    def flush(self):
        self.host.control(OUT, 0xC6, 0, 0)

    @stateful.rule(data=st.data(), again=st.booleans())
    def switch_off(self, data, again):
        self.host.write(*data.draw(st.sampled_from(self.RUN))[:2], 0)
        if again:
            self.run()

    @stateful.rule(again=st.booleans())
    def unplug(self, again):
        self.camera.detached()
        self.host = self.new_host()
        if again:
            self.run()

    @stateful.rule()
    def run(self):
        if not self.host.read(0, 1):
            self.host.new_decoder()
        self.host.write_all(self.RUN)

    @stateful.invariant()
    def the_host_finds_no_fault(self):
        assert self.host.decoder.faults.total == 0
