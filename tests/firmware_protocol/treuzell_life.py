"""The whole life of a camera on one of Prophesee's boards, told at random.

Every event and edge has exactly one fate, and the words say the events.
"""

import numpy as np
from evk4_requests import DATA, START, STOP, Host
from hypothesis import stateful
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.imx636.evk4 import Evk4, Evk4Settings

STEPS_US = st.sampled_from([0, 1, 3, 100, 5000, 2_000_000, 20_000_000])


class Life(stateful.RuleBasedStateMachine):
    """A camera under any sequence of events, edges, time, requests and reads: an EVK4 in EVT3."""

    OPENED, STARTED, STOPPED = ((0x7000, 0x0007_0001), (0x7004, 1 << 10)), START, STOP
    INTERRUPTIONS = (*STOP, (0x40_0004, 1), (0x9008, 0x645), (0x9028, 0), (0x0004, 0xF000_5442))
    DECODER = Evt3Decoder

    @staticmethod
    def new_camera():
        return Evk4(Evk4Settings(fifo_bytes=1024, start_delay_us=100))

    def __init__(self):
        super().__init__()
        self.camera = self.new_camera()
        self.host = Host(self.camera)
        self.start()
        self.open = []
        self.t_us = 0

    def start(self):
        self.host.write(*self.OPENED, *self.STARTED)
        self.decoder = self.DECODER()
        self.said, self.heard = ([], []), ([], [])

    @stateful.rule(data=st.data())
    def interrupt(self, data):
        self.host.write(data.draw(st.sampled_from(self.INTERRUPTIONS)))
        self.host.write(*self.STOPPED)
        self.start()

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=8), repeat=st.integers(1, 40), seed=st.integers(0, 9))
    def offer(self, steps, repeat, seed):
        events = np.zeros(len(steps) * repeat, EVENT)
        events["t"] = self.t_us + np.cumsum(np.tile(steps, repeat))
        rng = np.random.default_rng(seed)
        events["x"], events["y"] = rng.integers(0, 40, len(events)), rng.integers(0, 3, len(events))
        self.camera.offer(events)
        self.t_us = int(events["t"][-1])

    @stateful.rule(steps=st.lists(STEPS_US, min_size=1, max_size=4), back_us=STEPS_US, kinds=st.integers(0, 15))
    def offer_edges(self, steps, back_us, kinds):
        edges = np.zeros(len(steps), EDGE)
        edges["t"] = max(0, self.t_us - back_us) + np.cumsum(steps)
        edges["kind"] = [2 + (kinds >> k & 1) for k in range(len(steps))]
        self.camera.offer_edges(edges)

    @stateful.rule(step_us=STEPS_US)
    def advance(self, step_us):
        self.t_us += step_us
        self.camera.advance(self.t_us)

    @stateful.rule(max_bytes=st.sampled_from([1, 2, 5, 64, 512, 4096]), times=st.integers(1, 6), good=st.booleans())
    def read(self, max_bytes, times, good):
        for _ in range(times):
            transfer = self.camera.read(DATA, max_bytes)
            if transfer is None:
                return
            assert 0 < len(transfer.data) <= max_bytes
            (self.camera.sent if good else self.camera.lost)(transfer)
            self.hear(transfer)
            for k in range(2):
                assert self.heard[k][: len(self.said[k])] == self.said[k]

    def hear(self, transfer):
        """Take note of what a transfer says, and of what its words say."""
        heard = self.decoder.decode(transfer.data)
        for k, said in enumerate((transfer.events, transfer.edges)):
            own = said.copy()
            own["t"] -= np.uint64(transfer.epoch_us)
            self.said[k].extend(own.tolist())
            self.heard[k].extend(heard[k].tolist())

    @stateful.rule()
    def read_all(self):
        """When nothing is left, what transfers say that they complete is what was heard."""
        while (transfer := self.camera.read(DATA, 4096)) is not None:
            self.camera.sent(transfer)
            self.hear(transfer)
        assert self.said == self.heard

    @stateful.rule()
    def unplug(self):
        self.camera.detached()
        self.host = Host(self.camera)
        self.start()

    @stateful.invariant()
    def every_event_has_one_fate(self):
        counters = self.camera.counters
        assert counters.accounted == counters.offered
        assert counters.edges.accounted == counters.edges.offered
        assert self.camera.room_events >= 0
