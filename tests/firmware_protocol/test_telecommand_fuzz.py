"""Valid telecommands in random order at random moments, against every profile and every CAN transport. At length:

    EVSTIM_TELECOMMANDS=1000000 python -m pytest tests/firmware_protocol/test_telecommand_fuzz.py --timeout 0

Judged without the instrument's help: each event has a pixel and polarity of its own, so that what a receiver decodes
is compared with what was offered, and with what the link says has left.
"""

from __future__ import annotations

import os
import random
from collections import deque

import numpy as np
import pytest

from firmware_protocol.can_frames.raw_events import FD_CELLS
from firmware_protocol.can_frames.transport import IsoTpSender, cfp_frames
from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.addresses import Addresses
from firmware_protocol.packets.profile import PROFILES, Profile
from firmware_protocol.packets.telecommands import (
    Ping,
    RequestHousekeeping,
    SetBias,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Start,
    Stop,
)
from firmware_protocol.receiver.can import CanReceiver
from firmware_protocol.receiver.instrument import SerialReceiver
from transports.can_bus.carriage import sources
from transports.can_bus.kind import CanLink

SIZE = (346, 260)
PIXELS = SIZE[0] * SIZE[1]
CAN = {
    "can-raw": {"carriage": "raw"},
    "can-fd": {"carriage": "raw", "fd": True},
    "can-isotp": {"carriage": "isotp"},
    "can-isotp-fd": {"carriage": "isotp", "fd": True},
    "can-cfp": {"carriage": "cfp"},
}
NAMES = (*PROFILES, *CAN)
TELECOMMANDS = int(os.environ.get("EVSTIM_TELECOMMANDS", "600"))
TICKS_US = (1, 10, 100, 1000)
STEPS_US = (-1_000_000, -1234, -1, 0, 1, 77, 40_000)
LATEST_US = ((1 << 32) - 366 * 86_400) * 1_000_000


class SerialWay:
    """An instrument, a profile, and a computer's receiver; frames leave when `carry` is called."""

    def __init__(self, instrument, profile):
        self.instrument = instrument
        self.receiver = SerialReceiver(profile)
        self._profile = Profile(profile)
        self._commands = self._profile.command_unwrapper()
        self.left = deque()

    def tell(self, command):
        for received in self._commands.push(self.receiver.wrap(command)):
            self.instrument.command(received)

    def carry(self, lost=False):
        """Let one frame leave, or be lost by the link; False when there is none."""
        outgoing = self.instrument.next_message()
        if outgoing is None:
            return False
        data = self._profile.wrap(outgoing.message)
        if lost:
            self.instrument.lost(outgoing)
            return True
        self.receiver.push(data)
        self.instrument.sent(outgoing)
        self.left.append((outgoing.events, outgoing.epoch_us, outgoing.edges))
        return True


class CanWay:
    """The same over the frames of a CAN link; `add_items` is what a link's deliveries are told."""

    def __init__(self, instrument, p):
        self._p = p
        self.instrument = instrument
        self.receiver = CanReceiver(p.receiver)
        self._sources = sources(instrument, self, p)
        self._csp = p.carriage == "cfp"
        addresses = Addresses(csp_node=p.csp_address, csp_peer=p.csp_peer)
        self._profile = Profile("csp", addresses) if self._csp else Profile("ccsds")
        self._sender = IsoTpSender(p.receiver.isotp)
        self._packets = self._now_ns = 0
        self.left = deque()

    def add_items(self, outgoing):
        self.left.append((outgoing.events, outgoing.epoch_us, outgoing.edges))

    def tell(self, command):
        packet = self._profile.wrap_command(command)
        if self._csp:
            for frame in cfp_frames(packet, self._p.csp_peer, self._packets):
                self._hear(frame)
            self._packets += 1
            return
        self._sender.start(packet)
        while self._sender.busy:
            frame = self._sender.next_frame(self._tick())
            reply = self._hear(frame) if frame is not None else None
            if reply is not None:
                self._sender.flow_control(reply, self._tick())

    def carry(self, lost=False):
        for source in self._sources:
            frame = source.next_frame(self._tick())
            if frame is None:
                continue
            if lost:
                self._deliver(source, source.cut())
                source.drop()
                return True
            self.receiver.push(frame, self._now_ns)
            replies = self.receiver.take_replies()
            self._deliver(source, source.left())
            for reply in replies:
                self._hear(reply)
            return True
        return False

    def _deliver(self, source, outgoing):
        if outgoing is not None:
            source.delivered(outgoing)

    def _hear(self, frame):
        replies = [source.receive(frame, self._tick()) for source in self._sources]
        return next((reply for reply in replies if reply is not None), None)

    def _tick(self):
        self._now_ns += 1000
        return self._now_ns


class Fuzz:
    """One run; `step` does one random thing and checks that nothing was lost or made up."""

    def __init__(self, name, seed):
        self.random = random.Random(seed)
        draw = self.random
        settings = InstrumentSettings(
            tick_us=draw.choice(TICKS_US),
            block_events=draw.choice([1, 7, 2048]),
            block_bytes=draw.choice([64, 256, 1024]),
            when_full=draw.choice(["drop_oldest", "drop_newest"]),
            queue_events=draw.choice([2048, 65_536]),
            queue_ms=draw.choice([1, 100, 60_000]),
            housekeeping_s=draw.choice([0, 0.01, 1.0]),
            keep_every=draw.choice([1, 1, 3]),
            autostart=draw.random() < 0.9,
        )
        self.instrument = Instrument(SIZE, settings)
        if name in CAN:
            self.way = CanWay(self.instrument, CanLink(interface="virtual", instrument=settings, **CAN[name]))
        else:
            self.way = SerialWay(self.instrument, name)
        self._group = 4 * (FD_CELLS if name == "can-fd" else 2)  # events in the frames that leave together
        self.may_lose = name not in ("can-raw", "can-fd")  # a lost frame there is a lost epoch, hence a time in doubt
        self.now_us = draw.choice([0, 0, 1_000_000, 1 << 31, 1 << 36])
        self.commands = self.delivered = self._next_id = self._edge_seq = 0
        self._offered = {}
        self._pending, self._pending_edges = np.zeros(0, EVENT), np.zeros(0, EDGE)

    def step(self):
        draw = self.random.random()
        if draw < 0.45:
            self.way.tell(self._command())
            self.commands += 1
        elif draw < 0.75:
            self._offer()
        elif draw < 0.8:
            self._offer_edges()
        elif draw < 0.82:
            self.now_us += self.random.choice([1, 1000, 200_000, 10_000_000])
            self.instrument.advance(self.now_us)
        elif draw < 0.825:
            self.random.choice([self.instrument.disconnected, self.instrument.restart_clock, self._bus_time])()
            self.instrument.connected()
        elif draw < 0.83 and self.may_lose:
            self.way.carry(lost=True)
        else:
            for _ in range(self.random.choice([1, 2, 10, 100, 1000])):
                if not self.way.carry():
                    break
        self.check()

    def drain(self):
        """Let all that waits leave."""
        self.way.tell(SetRateLimit(0))
        self.instrument.connected()
        while self.way.carry():
            self.check()
        self.check()
        counters = self.instrument.counters
        assert counters.queued == 0, counters
        assert counters.edges.queued == 0, counters.edges

    def check(self):
        """Compare what was received with what has left, and the ledgers with what was offered."""
        counters, edges = self.instrument.counters, self.instrument.counters.edges
        assert counters.accounted == counters.offered, counters
        assert edges.accounted == edges.offered + edges.added, edges
        got, got_edges = self.way.receiver.take_events(), self.way.receiver.take_edges()
        got, got_edges = np.concatenate([self._pending, got]), np.concatenate([self._pending_edges, got_edges])
        while self.way.left:
            events, epoch_us, left_edges = self.way.left.popleft()
            shift = np.uint64(epoch_us % (1 << 64))
            same, got = got[: len(events)], got[len(events) :]
            assert np.array_equal(same["t"], events["t"] - shift), (same["t"][:5], events["t"][:5], epoch_us)
            assert np.array_equal(same[["x", "y", "on"]], events[["x", "y", "on"]])
            here, got_edges = got_edges[: len(left_edges)], got_edges[len(left_edges) :]
            assert np.array_equal(here["t"], left_edges["t"] - shift), (here, left_edges, epoch_us)
            assert np.array_equal(here[["kind", "seq"]], left_edges[["kind", "seq"]])
            self._judge(same, epoch_us)
            self.delivered += len(events)
        self._pending, self._pending_edges = got, got_edges  # raw frames of a message that has not left as a whole
        assert len(got) < self._group
        assert len(got_edges) <= 127

    def _judge(self, events, epoch_us):
        """Each event is one that was offered, once, and its time is cut by at most the ticks it went through."""
        for t_us, x, y, on in events.tolist():
            offered_us, tick_us = self._offered.pop((x, y, on))
            late_us = offered_us - (t_us + epoch_us)
            assert 0 <= late_us <= tick_us - 1 + 999, (offered_us, t_us, epoch_us, tick_us)

    def _command(self):
        r = self.random
        x, y = r.randrange(SIZE[0]), r.randrange(SIZE[1])
        return r.choice(
            [
                Ping(),
                RequestHousekeeping(),
                Start(),
                Start(),
                Stop(),
                SetTick(r.choice(TICKS_US)),
                SetTick(r.choice(TICKS_US)),
                SetTime(r.choice([0, 1, 999, 1 << 30, 1 << 32, (1 << 36) + 5, LATEST_US, r.randrange(LATEST_US)])),
                SetTime(min(LATEST_US, max(0, self.instrument.own_us + r.choice(STEPS_US)))),
                SetRegion(x, y, r.randint(1, SIZE[0] - x), r.randint(1, SIZE[1] - y)),
                SetRegion(0, 0, *SIZE),
                SetRegion(0, 0, *SIZE),
                SetRegion(0, 0, *SIZE),
                SetRateLimit(r.choice([0, 0, 1, 1000, 0xFFFF_FFFF])),
                SetBias(r.randrange(40), r.randrange(1 << 16)),
            ]
        )

    def _bus_time(self):
        now_us = self.instrument.own_us + self.random.randrange(-2_000_000, 2_000_000)
        self.instrument.set_time(min(max(0, now_us), LATEST_US))

    def _offer(self):
        count = self.random.choice([1, 2, 20, 300])
        gap_us = self.random.choice([0, 1, 3, 500, 40_000])
        events = np.zeros(count, EVENT)
        steps = np.array([self.random.randint(0, gap_us) for _ in range(count)])
        events["t"] = max(self.now_us, self.instrument.now_us) + np.cumsum(steps)
        numbers = (self._next_id + np.arange(count)) * 50_021 % (2 * PIXELS)  # 50 021 is prime: each comes once
        self._next_id += count
        events["x"], events["y"] = numbers // 2 % SIZE[0], numbers // 2 // SIZE[0]
        events["on"] = numbers % 2
        for t_us, x, y, on in events.tolist():
            self._offered[x, y, on] = t_us, self.instrument.tick_us
        self.now_us = int(events["t"][-1])
        self.instrument.offer(events)

    def _offer_edges(self):
        count = self.random.randint(1, 5)
        edges = np.zeros(count, EDGE)
        late = self.random.choice([0, 50, 5000])
        edges["t"] = max(0, self.instrument.now_us - late) + np.arange(count)
        edges["kind"], edges["seq"] = 2 + np.arange(count) % 3, (self._edge_seq + np.arange(count)) & 0xFFFF
        self._edge_seq += count
        self.instrument.offer_edges(edges)


def run(name, commands, seed):
    """Send at least so many telecommands, in runs of a few hundred steps each; return (telecommands, events)."""
    told = delivered = 0
    while told < commands:
        fuzz = Fuzz(name, f"{name} {seed} {told}")
        while fuzz.commands < min(200, commands - told):
            fuzz.step()
        fuzz.drain()
        assert fuzz.way.receiver.faults == 0 or fuzz.may_lose, fuzz.way.receiver.counts
        told, delivered = told + fuzz.commands, delivered + fuzz.delivered
    return told, delivered


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("name", NAMES)
def test_valid_telecommands_at_random_moments_hurt_nothing(name):
    told, delivered = run(name, TELECOMMANDS, seed=7)
    assert told >= TELECOMMANDS
    assert delivered > 50
