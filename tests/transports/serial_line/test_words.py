"""A sensor's words on a pty: read by programs of others, repeated times, and the fates of events that do not fit."""

import time

import numpy as np
import pytest
from line_bench import ORIGIN_NS, PATIENCE_S

from emulator.rig.loading import RigError, parse_rig
from firmware_protocol.events import EdgeKind
from firmware_protocol.evt.evt2 import Evt2Decoder
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.instrument.settings import InstrumentSettings
from tests.made_events import events_at
from tests.transports.word_readers import MANY, OCTETS, check_words, rows, spif_events
from transports.link.rings import FREE_RUNNING

FAST = 20_000_000
FORMS = [form for form in OCTETS if form != "spif"]


class Wire:
    """The bytes that a reader of the bench's pty has read; the bench's own receiver gets none."""

    def __init__(self, bench):
        self._bench, self._parts = bench, []
        self.count = bench.link.report().use.carried  # bytes of earlier readers
        bench.plug()

    def run(self, ticks):
        for _ in range(ticks):
            self._bench.run(1, read=False)
            self.take()

    def take(self):
        while part := self._bench.port.read(1 << 16):
            self._parts.append(part)
            self.count += len(part)

    def all(self):
        """Return all bytes that have left the line; the kernel hands them over in its own time."""
        carried, deadline = self._bench.link.report().use.carried, time.monotonic() + PATIENCE_S
        while self.count < carried:
            assert time.monotonic() < deadline, f"{self.count} of {carried} bytes came"
            self.take()
        return b"".join(self._parts)


def decoded(form, data):
    return (Evt3Decoder() if form == "evt3" else Evt2Decoder(form)).decode(data)


@pytest.mark.sampled
@pytest.mark.parametrize("form", list(OCTETS))
def test_a_million_events_on_a_line_are_read_exactly(bench, form, tmp_path):
    b = bench(format=form, baud=FAST)
    wire, events = Wire(b), rows(MANY)
    b.ring.start(FREE_RUNNING)
    for part in np.array_split(events, 20):
        b.give(part, int(part["t"][-1]))
        while b.ring.waiting:
            wire.run(1)
    b.ring.publish(int(events["t"][-1]) + 1)
    while not b.link.idle:
        wire.run(1)
    report = b.link.report()
    assert (report.delivered, report.camera.accounted) == (MANY, MANY)
    check_words(form, wire.all(), events, tmp_path)


@pytest.mark.parametrize("form", list(OCTETS))
def test_what_does_not_fit_a_narrow_line_is_counted(bench, form):
    b = bench(format=form, baud=115_200, settings=InstrumentSettings(queue_ms=20))
    wire, events = Wire(b), rows(60_000, every_us=150)
    b.ring.start(ORIGIN_NS)
    b.give(events, int(events["t"][-1]))
    wire.run(2400)
    c = b.link.report().camera
    data = wire.all()
    seen = spif_events(data) if form == "spif" else decoded(form, data)[0]
    assert c.dropped_late > 20_000
    assert c.accounted == c.offered == 60_000
    assert c.delivered <= len(seen) <= c.delivered + c.queued
    if form != "spif":
        assert np.isin(seen, events).all()
    assert b.link.report().use.busiest > 0.98


@pytest.mark.parametrize("form", FORMS)
def test_a_silent_line_repeats_the_time(bench, form):
    """At 12 Mbit/s a high part comes every 16 us of EVT3, 32 us of EVT2, 64 us of EVT2.1: an eighth of the line."""
    b = bench(format=form, baud=12_000_000)
    wire = Wire(b)
    b.ring.start(ORIGIN_NS)
    for tick in range(100):
        b.ring.publish(500 * (tick + 1))
        wire.run(1)
    words = len(wire.all()) // OCTETS[form]
    period_us = {"evt2": 32, "evt21": 64, "evt3": 16}[form]
    assert 0.9 * 50_000 / period_us < words <= 50_000 / period_us + 1
    assert 0.1 < b.link.report().use.share <= 0.14


@pytest.mark.parametrize("form", FORMS)
def test_a_receiver_that_joins_late_reads_all_but_the_first_period(bench, form):
    b = bench(format=form, baud=12_000_000)
    wire, events = Wire(b), rows(40_000, every_us=60)
    b.ring.start(ORIGIN_NS)
    b.give(events, int(events["t"][-1]))
    wire.run(900)
    data = wire.all()
    assert len(decoded(form, data)[0]) == 40_000
    cut = len(data) // 2 // OCTETS[form] * OCTETS[form]
    seen = decoded(form, data[cut:])[0]
    missed = 40_000 - len(seen) - len(decoded(form, data[:cut])[0])
    np.testing.assert_array_equal(seen, events[40_000 - len(seen) :])
    assert missed < 50


@pytest.mark.parametrize("form", FORMS)
def test_edges_come_in_order_with_the_events(bench, form):
    b = bench(format=form, baud=12_000_000)
    wire, events = Wire(b), rows(2000)
    b.ring.start(ORIGIN_NS)
    b.link.happen(EdgeKind.RISING)
    b.give(events, int(events["t"][-1]))
    wire.run(30)
    b.link.happen(EdgeKind.PULSE)
    b.ring.publish(20_000)
    wire.run(30)
    seen, edges = decoded(form, wire.all())
    np.testing.assert_array_equal(seen, events)
    assert [EdgeKind(kind).name for kind in edges["kind"]] == ["RISING", "RISING", "FALLING"]
    c = b.link.report().camera.edges
    assert (c.delivered, c.accounted) == (2, 2)


def test_a_restart_of_the_clock_begins_the_time_again(bench):
    b = bench(format="evt2", baud=12_000_000)
    wire, events = Wire(b), rows(2000)
    b.ring.start(ORIGIN_NS)
    b.give(events[:1000], int(events["t"][999]))
    wire.run(40)
    b.link.happen(None)
    wire.run(1)
    epoch_us = int(events["t"][999])
    later = rows(1000)
    later["t"] += np.uint64(epoch_us)
    b.give(later, int(later["t"][-1]))
    wire.run(60)
    seen = decoded("evt2", wire.all())[0]
    assert len(seen) == 2000
    assert int(seen["t"][1000]) % (1 << 34) < 1000


def test_the_next_reader_gets_a_stream_of_its_own(bench):
    """It comes while high part, row and period are those of the first reader."""
    b = bench(format="evt3", baud=9600)
    Wire(b).run(1)
    b.ring.start(ORIGIN_NS)
    events = events_at(4200 + 100 * np.arange(30), y=7)
    b.give(events, 7200)
    b.run(9, read=False)
    b.port.close()
    b.run(2, read=False)
    assert b.link.report().dropped > 0
    wire = Wire(b)
    wire.run(400)
    data = wire.all()
    assert data[1] >> 4 == 8
    seen = decoded("evt3", data)[0]
    assert len(seen) > 3
    assert np.isin(seen, events).all()
    assert b.link.report().attach_command == ""


RIG = '[scene]\nkind = "checkerboard"\n[[links]]\nkind = "serial"\nformat = "evt3"\n'


@pytest.mark.parametrize(("more", "told"), [
    ('profile = "fprime"', 'profile is of the format "telemetry"; evt3 has neither packets nor framing'),
    ("[links.instrument]\ntick_us = 10", "tick_us must be 1 with evt3, got 10"),
    ('[[faults]]\nkind = "bit_flips"\nat_s = 1.0\nfor_s = 1.0\nrate = 0.1', "bit_flips"),
])  # fmt: skip
def test_a_rig_whose_words_cannot_be_is_refused_with_a_reason(more, told):
    with pytest.raises(RigError, match=told):
        parse_rig(RIG + more, "a.toml", "a")
