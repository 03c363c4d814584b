"""The instrument through any life: telecommands, events and a line that comes and goes, in any order."""

import dataclasses

import hypothesis.strategies as st
import numpy as np
from hypothesis import settings, stateful
from instrument_ground import SIZE, Ground, edges, stream

from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.telecommands import (
    Ping,
    RequestHousekeeping,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Start,
    Stop,
)


class Life(stateful.RuleBasedStateMachine):
    """An instrument through anything: the fates always sum up, and what is heard is what it says it sent."""

    def __init__(self):
        super().__init__()
        small = InstrumentSettings(block_events=32, queue_events=200, queue_ms=5, housekeeping_s=0.05, block_bytes=128)
        self.instrument = Instrument(SIZE, small)
        self.ground = Ground(self.instrument)
        self.t_us = 0

    @stateful.rule(count=st.integers(1, 120), every=st.integers(0, 400), seed=st.integers(0, 9))
    def offer(self, count, every, seed):
        self.instrument.offer(stream(count, every, self.t_us, seed))
        self.t_us += (count - 1) * every

    @stateful.rule(step=st.integers(0, 20_000))
    def advance(self, step):
        self.t_us += step
        self.instrument.advance(self.t_us)

    @stateful.rule(most=st.integers(1, 5))
    def pull(self, most):
        self.ground.pull(most)

    @stateful.rule()
    def lose(self):
        out = self.instrument.next_message()
        if out is not None:
            self.instrument.lost(out)

    @stateful.rule(count=st.integers(1, 5))
    def trigger(self, count):
        self.instrument.offer_edges(edges(*[max(0, self.t_us - i) for i in range(count)]))

    @stateful.rule(
        command=st.sampled_from(
            [Start(), Stop(), SetTick(10), SetTick(1), SetRegion(5, 5, 50, 50), SetRegion(0, 0, *SIZE), SetRateLimit(0)]
            + [SetRateLimit(5000), SetTime(0), SetTime(10**15), Ping(), RequestHousekeeping()]
        )
    )
    def tell(self, command):
        self.ground.tell(command)

    @stateful.rule(again=st.booleans())
    def hang_up(self, again):
        self.instrument.disconnected()
        if again:
            self.instrument.connected()

    @stateful.invariant()
    def every_event_has_one_fate(self):
        c = self.instrument.counters
        assert c.accounted == c.offered
        assert c.edges.accounted == c.edges.offered
        assert min(fate for fate in dataclasses.astuple(c) if isinstance(fate, int)) >= 0

    @stateful.invariant()
    def what_is_heard_was_sent(self):
        heard = sum(len(events) for events in self.ground.events)
        assert heard == self.instrument.counters.delivered
        for out, block in zip([o for o in self.ground.outgoing if len(o.events)], self._event_blocks(), strict=True):
            seen = out.events.copy()
            seen["t"] -= np.uint64(out.epoch_us % (1 << 64))
            assert np.array_equal(seen, block.events)

    def _event_blocks(self):
        return [block for block in self.ground.blocks if len(block.events)]


Life.TestCase.settings = settings(stateful_step_count=25)
test_any_life_of_an_instrument_balances = Life.TestCase
