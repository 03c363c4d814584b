"""The camera without USB: what it says, what it does when told, and that every event has one fate."""

import dataclasses

import numpy as np
import pytest
from instrument_ground import SIZE, Ground, edges, stream

from firmware_protocol.device.fates import Fates
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.addresses import MessageKind
from firmware_protocol.packets.housekeeping import Housekeeping, Mode, TimeReport, TimeStatus
from firmware_protocol.packets.telecommands import (
    FailureCode,
    Ping,
    RequestHousekeeping,
    SetRateLimit,
    SetRegion,
    SetTick,
    SetTime,
    Stage,
    Start,
    Stop,
)
from firmware_protocol.telemetry.reading import as_received

GOOD = [(Stage.ACCEPTANCE, None), (Stage.COMPLETION, None)]


@pytest.fixture
def make():
    """Make an instrument with its ground; housekeeping only when asked for."""

    def made(**changes):
        instrument = Instrument(SIZE, InstrumentSettings(**{"housekeeping_s": 0, **changes}))
        return instrument, Ground(instrument)

    return made


def ends(verifications):
    return [(v.stage, v.failure and v.failure.code) for v in verifications]


def by_time(events):
    return events[np.lexsort((events["x"], events["y"], events["t"]))]


def test_what_is_offered_is_what_is_decoded(make):
    instrument, ground = make()
    offered = stream(5000)
    instrument.offer(offered)
    ground.pull()
    assert np.array_equal(np.concatenate(ground.events), by_time(offered))
    assert instrument.counters == Fates(offered=5000, delivered=5000)
    assert np.array_equal(np.concatenate(ground.events), np.concatenate([out.events for out in ground.outgoing]))


def test_a_block_is_formed_when_the_line_asks(make):
    instrument, ground = make()
    for start_us in range(0, 5000, 100):
        instrument.offer(stream(10, start_us=start_us))
    assert ground.pull() == 2, "500 events in blocks of a kilobyte, not one block for each offer"


def test_nothing_flows_before_start_without_autostart(make):
    instrument, ground = make(autostart=False)
    instrument.offer(stream(10))
    assert ground.pull() == 0
    assert not instrument.streaming
    assert ends(ground.tell(Start())) == GOOD
    instrument.offer(stream(10, start_us=1000))
    ground.pull()
    assert instrument.counters == Fates(offered=20, not_running=10, delivered=10)


def test_stop_drops_what_waits_and_the_next_block_tells(make):
    instrument, ground = make()
    instrument.offer(stream(10))
    assert ends(ground.tell(Stop())) == GOOD
    assert instrument.counters.flushed == 10
    ground.tell(Start())
    instrument.offer(stream(5, start_us=1000))
    ground.pull()
    assert [block.header.dropped for block in ground.blocks] == [10]


def test_a_line_that_hangs_up_drops_what_waits(make):
    instrument, ground = make()
    instrument.offer(stream(10))
    instrument.disconnected()
    instrument.offer(stream(10, start_us=1000))
    instrument.offer_edges(edges(1100))
    assert instrument.counters.edges.ignored == 1
    instrument.connected()
    instrument.offer(stream(10, start_us=2000))
    ground.pull()
    assert instrument.counters.delivered == 10
    assert instrument.counters.flushed == instrument.counters.not_running == 10


def test_ping_and_time_are_answered(make):
    instrument, ground = make()
    instrument.advance(700)
    assert ends(ground.tell(Ping())) == GOOD
    assert ground.of_kind(MessageKind.PONG) == [b""]
    assert ends(ground.tell(SetTime(5_000_000))) == GOOD
    assert TimeReport.parse(ground.of_kind(MessageKind.TIME)[0]) == TimeReport(5_000_000, TimeStatus.SET)
    assert instrument.own_us == 5_000_000


def test_events_bear_the_time_that_was_set(make):
    instrument, ground = make()
    instrument.advance(1000)
    ground.tell(SetTime(1_700_000_000_000_000))
    offered = stream(3, start_us=1500)
    instrument.offer(offered)
    instrument.offer_edges(edges(1600))
    ground.pull()
    assert ground.events[-1]["t"].tolist() == [1_700_000_000_000_500 + 10 * i for i in range(3)]
    assert ground.edges[0]["t"].tolist() == [1_700_000_000_000_600]
    out = ground.outgoing[-1]
    assert out.events["t"].tolist() == [1500, 1510, 1520]
    assert out.epoch_us == 1000 - 1_700_000_000_000_000


def test_time_set_back_to_zero_leaves_no_event_before_it(make):
    instrument, ground = make()
    instrument.offer(stream(10, start_us=1000))
    instrument.advance(2000)
    ground.instrument.set_time(0)
    assert instrument.counters.flushed == 10
    instrument.offer_edges(edges(1999))
    instrument.offer(stream(1, start_us=2500))
    ground.pull()
    assert np.concatenate(ground.events)["t"].tolist() == [500]
    assert instrument.counters.edges.ignored == 1


def test_a_time_beyond_the_seconds_is_refused(make):
    _, ground = make()
    told = ends(ground.tell(SetTime(4_294_967_295_000_000)))
    assert told == [(Stage.ACCEPTANCE, None), (Stage.COMPLETION, FailureCode.ILLEGAL_DATA)]


def test_region_and_tick_can_be_told(make):
    instrument, ground = make()
    assert ends(ground.tell(SetRegion(10, 20, 100, 50))) == GOOD
    assert ends(ground.tell(SetTick(100))) == GOOD
    offered = stream(2000)
    instrument.offer(offered)
    ground.pull()
    inside = (offered["x"] >= 10) & (offered["x"] < 110) & (offered["y"] >= 20) & (offered["y"] < 70)
    assert np.array_equal(np.concatenate(ground.events), as_received(offered[inside], 100))
    assert instrument.counters.not_selected == 2000 - inside.sum()


@pytest.mark.parametrize("region", [SetRegion(300, 0, 47, 10), SetRegion(0, 250, 10, 11)])
def test_a_region_beyond_the_array_is_refused(make, region):
    _, ground = make()
    assert ends(ground.tell(region))[1] == (Stage.COMPLETION, FailureCode.ILLEGAL_DATA)


def test_sub_sampling_keeps_pixels_of_a_grid(make):
    instrument, ground = make(keep_every=4, region=(0, 0, 100, 100))
    offered = stream(3000)
    instrument.offer(offered)
    ground.pull()
    kept = (offered["x"] % 4 == 0) & (offered["y"] % 4 == 0) & (offered["x"] < 100) & (offered["y"] < 100)
    assert np.array_equal(np.concatenate(ground.events), by_time(offered[kept]))


def test_the_rate_is_kept_and_the_excess_counted(make):
    instrument, ground = make(block_events=50, queue_ms=20)
    ground.tell(SetRateLimit(10_000))
    for ms in range(2000):
        instrument.offer(stream(100, start_us=ms * 1000))
        instrument.advance(ms * 1000 + 999)
        ground.pull()
    c = instrument.counters
    assert 19_800 <= c.delivered <= 20_400
    assert c.dropped_rate == c.offered - c.delivered - c.queued
    assert sum(block.header.dropped for block in ground.blocks) <= c.dropped_rate
    assert sum(block.header.dropped for block in ground.blocks) > 0.95 * c.dropped_rate
    ground.tell(SetRateLimit(0))
    instrument.offer(stream(100, start_us=2_000_000))
    ground.pull()
    assert instrument.counters.queued == 0


@pytest.mark.parametrize("policy", ["drop_oldest", "drop_newest"])
def test_gaps_are_told_where_they_are(make, policy):
    """Sequence of what was offered, with the dropped counts put in, is complete: no gap inside a block."""
    instrument, ground = make(when_full=policy, queue_events=2048, block_events=256)
    offered = stream(20_000, every_us=1)
    order = {}
    for at in range(0, 20_000, 500):
        instrument.offer(offered[at : at + 500])
        ground.pull(1)
    ground.pull()
    for index, t in enumerate(offered["t"].tolist()):
        order[t] = index
    expected = 0
    for block in ground.blocks:
        expected += block.header.dropped
        assert [order[t] for t in block.events["t"].tolist()] == list(range(expected, expected + len(block.events)))
        expected += len(block.events)
    assert instrument.counters.dropped_fifo > 0
    assert instrument.counters.accounted == 20_000


def test_housekeeping_comes_at_its_rate_and_on_request(make):
    instrument, ground = make(housekeeping_s=0.1)
    for ms in range(1000):
        instrument.offer(stream(5, start_us=ms * 1000))
        instrument.advance(ms * 1000 + 999)
        ground.pull()
    reports = [Housekeeping.parse(payload) for payload in ground.of_kind(MessageKind.HOUSEKEEPING)]
    assert len(reports) == 10
    assert reports[5].offered_hz == pytest.approx(5000, rel=0.02)
    assert reports[5].mode is Mode.STREAMING
    last = reports[-1].events
    assert last.offered == sum(dataclasses.astuple(last)[1:])
    ground.tell(RequestHousekeeping())
    report = Housekeeping.parse(ground.of_kind(MessageKind.HOUSEKEEPING)[-1])
    assert report.events.offered == report.events.sent == 5000
    assert report.link.commands_taken == 0, "the request itself is not done yet"


def test_edges_go_before_events(make):
    instrument, ground = make()
    instrument.offer(stream(10))
    instrument.offer_edges(edges(5, 3))
    ground.pull()
    assert [message.kind for message in ground.heard] == [MessageKind.EDGES, MessageKind.EVENTS]
    assert ground.edges[0]["t"].tolist() == [3, 5]
    assert instrument.counters.edges.delivered == 2


def test_too_many_edges_are_dropped_and_told(make):
    instrument, ground = make()
    instrument.offer_edges(edges(*range(5000)))
    ground.pull()
    assert instrument.counters.edges.delivered == 4096
    assert instrument.counters.edges.dropped_fifo == 904
    assert sum(block.header.dropped for block in ground.blocks) == 904


def test_a_link_may_pack_the_events_itself(make):
    instrument, _ = make()
    offered = stream(10)
    instrument.offer(offered)
    assert instrument.next_message(events=False) is None
    out = instrument.next_events(4)
    assert np.array_equal(out.events, offered[:4])
    assert out.message.payload == b""
    instrument.lost(out)
    assert instrument.counters == Fates(offered=10, lost_on_link=4, queued=6)


def test_bad_events_are_refused_whole(make):
    instrument, _ = make()
    instrument.advance(100)
    outside, backwards, past = stream(3, start_us=200), stream(3, start_us=200), stream(3)
    outside["x"][1] = SIZE[0]
    backwards["t"][2] = 150
    for bad in (outside, backwards, past):
        with pytest.raises(ValueError, match=r"outside|sorted|after"):
            instrument.offer(bad)
    assert instrument.counters == Fates()


@pytest.mark.parametrize(
    ("field", "value"),
    [
        ("block_events", 0),
        ("block_bytes", 10),
        ("region", (1, 2, 3)),
        ("region", (0, 0, 0, 5)),
        ("keep_every", 0),
        ("rate_limit", -1),
        ("queue_events", 1),
        ("queue_ms", 0),
        ("housekeeping_s", 0.001),
        ("temperature_c", -300),
    ],
)
def test_settings_refuse_nonsense_by_the_key(field, value):
    with pytest.raises(ValueError, match=field):
        InstrumentSettings(**{field: value})


def test_a_region_must_lie_on_the_array():
    with pytest.raises(ValueError, match="reaches beyond the 346x260"):
        Instrument(SIZE, InstrumentSettings(region=(0, 0, 400, 10)))


def test_a_clock_that_starts_anew_counts_from_zero(make):
    instrument, ground = make()
    instrument.advance(5_000_000)
    ground.tell(SetTime(7_000_000))
    assert instrument.epoch_us == -2_000_000
    instrument.offer(stream(10, start_us=5_000_000))
    assert instrument.restart_clock()
    assert instrument.epoch_us == instrument.now_us
    assert instrument.counters.flushed == 10
    later = stream(10, start_us=instrument.now_us + 100)
    instrument.offer(later)
    instrument.offer_edges(edges(later["t"][0] - 91))
    ground.pull()
    assert min(events["t"].min() for events in ground.events if len(events)) == 100
    assert [found["t"].tolist() for found in ground.edges if len(found)] == [[9]]
