"""Times of raw frames are exact at every tick, far from zero, over jumps of the clock, and for late joiners."""

import numpy as np
import pytest
import raw_strategies as raw
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import RawError, pack_clock, unpack_clock
from firmware_protocol.can_frames.raw_stream import RawReceiver, RawSender, RawSettings
from firmware_protocol.events import EVENT
from tests.made_events import events_at

IDS = raw.IDS


def joined(parts):
    return np.concatenate([np.zeros(0, EVENT), *parts])


def receiver_of():
    return RawReceiver(IDS.events, IDS.epoch, IDS.clock)


@given(raw.jumping_streams(), st.booleans())
def test_a_receiver_from_the_start_gets_every_time(parts, fd):
    frames, expected = raw.frames_of(parts, fd=fd)
    receiver = receiver_of()
    assert np.array_equal(joined(receiver.push(frame) for frame in frames), joined(expected))
    assert receiver.counters.before_clock == receiver.counters.before_epoch == receiver.counters.malformed == 0


@pytest.mark.system
@given(raw.jumping_streams(), st.booleans(), st.integers(0, 40))
def test_a_late_joiner_gets_times_modulo_2_to_30_ticks_until_a_clock_frame_and_all_bits_after(parts, fd, joins):
    frames, expected = raw.frames_of([(events, parts[0][1]) for events, _ in parts], fd=fd)
    receiver, clocked, timed = receiver_of(), False, False
    for frame, events in list(zip(frames, expected, strict=True))[joins:]:
        got = receiver.push(frame)
        clocked |= frame.identifier == IDS.clock
        timed |= frame.identifier == IDS.epoch
        if not timed:
            assert len(got) == 0
        elif clocked:
            assert np.array_equal(got, events)
        else:
            span_us = np.uint64(parts[0][1] << 30)
            assert np.array_equal(got["t"] % span_us, events["t"] % span_us)


@pytest.mark.parametrize("tick_us", raw.TICKS_US)
@pytest.mark.parametrize("start_us", [(1 << 30) + 7, (1 << 36) - 20_000, 1 << 40])
def test_times_beyond_30_bits_of_microseconds(tick_us, start_us):
    """The figures of the fault that was found: 1 048 576 us off at a tick of 10 us after 2^30 us."""
    events = events_at(start_us + 137 * np.arange(500))
    sender = RawSender(RawSettings(IDS.events, IDS.epoch, tick_us, clock=IDS.clock))
    receiver = receiver_of()
    got = joined(receiver.push(packed.frame) for packed in sender.pack(events))
    assert np.array_equal(got["t"], events["t"] // tick_us * tick_us)


def test_a_clock_frame_comes_first_then_once_a_second():
    sender = RawSender(RawSettings(IDS.events, IDS.epoch, clock=IDS.clock))
    told = []
    for now_us in range(0, 3_000_000, 10_000):
        told += [(now_us, p.frame.identifier) for p in sender.epoch(now_us, 0)]
    assert told[:2] == [(0, IDS.clock), (0, IDS.epoch)]
    assert [t for t, identifier in told if identifier == IDS.clock] == [0, 1_000_000, 2_000_000]


def test_frames_that_never_left_are_made_up_for():
    sender = RawSender(RawSettings(IDS.events, IDS.epoch, clock=IDS.clock))
    assert len(sender.epoch(5, 0)) == 2
    assert sender.epoch(6, 0) == []
    sender.forget()
    assert [p.frame.identifier for p in sender.epoch(6, 0)] == [IDS.clock, IDS.epoch]


def test_an_edge_far_from_the_time_told_has_its_time_told_first():
    sender = RawSender(RawSettings(IDS.events, IDS.epoch, clock=IDS.clock))
    assert [p.frame.identifier for p in sender.time_frames(1 << 35)] == [IDS.clock, IDS.epoch]
    assert sender.time_frames((1 << 35) + 999_999) == []
    assert len(sender.time_frames(0)) == 2


def test_a_clock_frame():
    assert pack_clock(0x0123_4567_89AB) == bytes.fromhex("ab89674523010000")
    assert unpack_clock(bytes.fromhex("ab89674523010000")) == 0x0123_4567_89AB
    for wrong in (bytes(7), b"\xff" * 8):
        with pytest.raises(RawError):
            unpack_clock(wrong)
    receiver = receiver_of()
    receiver.push(Frame(IDS.clock, bytes(7)))
    assert receiver.counters.malformed == 1
