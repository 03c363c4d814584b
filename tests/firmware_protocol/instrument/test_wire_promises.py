"""Promises of docs/packets.md and docs/instrument.md that are easily broken."""

import numpy as np
from instrument_ground import SIZE, Ground, stream

from firmware_protocol.events import EDGE
from firmware_protocol.instrument.instrument import Instrument
from firmware_protocol.instrument.settings import InstrumentSettings
from firmware_protocol.packets.addresses import MessageKind
from firmware_protocol.packets.housekeeping import Housekeeping, TimeStatus
from firmware_protocol.packets.telecommands import RequestHousekeeping, SetRegion, SetTick, SetTime, Stop

QUIET = {"housekeeping_s": 0}


def ground_of(**more):
    return Ground(Instrument(SIZE, InstrumentSettings(**{**QUIET, **more})))


def test_a_packet_of_events_has_the_time_of_its_first_event():
    ground = ground_of()
    ground.instrument.offer(stream(10, every_us=100, start_us=7777))
    ground.instrument.offer_edges(np.array([(5000, 2, 0, 1)], EDGE))
    ground.pull()
    assert {message.kind: message.t_us for message in ground.heard} == {
        MessageKind.EVENTS: 7777,
        MessageKind.EDGES: 5000,
    }


def test_housekeeping_tells_the_cameras_own_time():
    ground = ground_of()
    ground.instrument.advance(1000)
    ground.tell(SetTime(50_000_000))
    ground.instrument.advance(1500)
    ground.tell(RequestHousekeeping())
    report = Housekeeping.parse(ground.of_kind(MessageKind.HOUSEKEEPING)[0])
    assert (report.t_us, report.time_status) == (50_000_500, TimeStatus.SET)


def test_more_dropped_events_than_a_header_holds_are_told_by_the_blocks_that_follow():
    ground = ground_of(queue_events=4096, queue_ms=60_000)
    ground.instrument.offer(stream(150_000, every_us=1))
    ground.pull()
    assert [block.header.dropped for block in ground.blocks][:3] == [65_535, 65_535, 150_000 - 4096 - 2 * 65_535]
    assert sum(block.header.dropped for block in ground.blocks) == 150_000 - 4096


def test_what_links_tell_as_dropped_leaves_out_what_was_not_to_be_sent():
    ground = ground_of(queue_events=2048, queue_ms=60_000)
    ground.tell(SetRegion(0, 0, 1, 1))
    ground.instrument.offer(stream(1000))
    ground.tell(SetRegion(0, 0, *SIZE))
    ground.instrument.offer(stream(2050, start_us=10_000))
    ground.tell(Stop())
    ground.instrument.offer(stream(50, start_us=50_000))
    counters = ground.instrument.counters
    assert counters.not_selected >= 990
    assert counters.not_running == 50
    assert counters.dropped_for_room == counters.dropped_fifo + counters.flushed
    assert counters.dropped_for_room + counters.delivered == 3000 - counters.not_selected + 50


def test_the_tick_may_change_while_events_wait():
    """The fault that was found: SetTick 1000, then 1, with events before, between and after."""
    ground = ground_of()
    instrument = ground.instrument
    for tick_us in (1000, 1):
        instrument.offer(stream(3, every_us=100, start_us=instrument.now_us + 100))
        instrument.execute(SetTick(tick_us))
    instrument.offer(stream(3, every_us=100, start_us=instrument.now_us + 100))
    ground.pull()
    (block,) = ground.blocks
    assert block.header.tick_us == 1
    assert block.events["t"].tolist() == [100, 200, 300, 300, 300, 300, 700, 800, 900]
