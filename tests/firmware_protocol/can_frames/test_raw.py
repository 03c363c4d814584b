"""Raw frames: golden vectors, round trips, and what becomes of lost, repeated and reordered ones."""

from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.raw_events import (
    Epoch,
    RawError,
    pack_events,
    pack_fd_events,
    unpack_events,
    unpack_fd_events,
    unwrapped,
)
from firmware_protocol.can_frames.raw_stream import RawReceiver, RawSender, RawSettings
from firmware_protocol.events import EVENT
from tests.made_events import events_at

EVENTS, EPOCH = 0x1A2, 0x2A2


def made(*records):
    return np.array(list(records), EVENT)


@st.composite
def streams(draw, most=60):
    gaps = draw(st.lists(st.sampled_from([0, 1, 30, 31, 126, 127, 5_000, 40_000, 2_000_000]), max_size=most))
    events = events_at(np.cumsum([draw(st.integers(0, 1 << 33)), *gaps])[1:])
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    events["x"], events["y"] = rng.integers(0, 512, (2, len(gaps)))
    events["on"] = rng.integers(0, 2, len(gaps))
    return events


def from_the_first(events):
    """Time since the first event: a receiver that has just come knows 30 bits of time and no more."""
    events = events.copy()
    events["t"] -= events["t"][:1] if len(events) else 0
    return events


def sent_in_parts(events, raw, parts):
    sender = RawSender(raw)
    return [packed for part in np.array_split(events, parts) for packed in sender.pack(part)], sender


def tell(receiver, packed):
    for one in packed:
        receiver.push(one.frame)


def test_two_events_in_eight_bytes():
    data, first = pack_events(made((0x12345, 345, 259, True), (0x12345 + 100, 1, 2, False)), 1, 5)
    word = 0x2345 | 5 << 16 | 100 << 19 | 345 << 26 | 259 << 35 | 1 << 44 | 1 << 45 | 2 << 54
    assert data == [word.to_bytes(8, "little")]
    assert list(first) == [0]


def test_an_epoch_frame():
    data = bytes(Epoch(ticks=(1 << 30) + 5, tick_us=100, sent=65_537, dropped=3))
    assert data == (5 | 2 << 30).to_bytes(4, "little") + b"\x01\x00\x03\x00"
    assert Epoch.parse(data) == Epoch(5, 100, 1, 3)


def test_an_fd_frame_with_a_skip():
    ((data, n),) = pack_fd_events(made((10, 1, 2, True), (1000, 3, 4, False)), 1, 9, dropped=2)
    cells = [1 | 2 << 9 | 1 << 18, 990 | 31 << 19, 3 | 4 << 9]
    assert data == b"\x0a\0\0\0\x09\x03\x02" + b"".join(c.to_bytes(3, "little") for c in cells)
    assert n == 2


@given(streams(), st.sampled_from([1, 10, 100, 1000]), st.integers(1, 5), st.booleans())
def test_every_event_comes_back_at_its_tick(events, tick_us, parts, fd):
    packed, sender = sent_in_parts(events, RawSettings(EVENTS, EPOCH, tick_us, fd=fd), parts)
    receiver = RawReceiver(EVENTS, EPOCH)
    got = np.concatenate([receiver.push(p.frame) for p in packed]) if packed else events
    expected = events.copy()
    expected["t"] = expected["t"] // tick_us * tick_us
    assert np.array_equal(from_the_first(got), from_the_first(expected))
    assert np.array_equal(np.concatenate([events[:0], *(p.events for p in packed)]), events)
    last = sender.epoch(int(events["t"][-1]) + 20_000 if len(events) else 0, 0)
    tell(receiver, last)
    assert (receiver.counters.lost, receiver.counters.gaps, receiver.counters.malformed) == (0, 0, 0)


@given(streams(most=80), st.booleans(), st.data())
def test_lost_and_repeated_frames_are_counted_and_hurt_no_other(events, fd, data):
    packed, sender = sent_in_parts(events, RawSettings(EVENTS, EPOCH, fd=fd), 3)
    receiver = RawReceiver(EVENTS, EPOCH)
    got, expected, lost = [events[:0]], [events[:0]], 0
    for p in packed:
        carries = len(p.events) > 0
        fate = data.draw(st.sampled_from(["sent", "lost", "twice"] if carries else ["sent"]))
        if fate == "lost":
            lost += len(p.events)
            continue
        expected.append(p.events)
        got += [receiver.push(p.frame) for _ in range(2 if fate == "twice" else 1)]
    tell(receiver, sender.epoch(1 << 40, 0))
    assert np.array_equal(from_the_first(np.concatenate(got)), from_the_first(np.concatenate(expected)))
    assert receiver.counters.lost == lost
    assert receiver.counters.events == len(events) - lost


def test_reordered_frames_keep_their_times():
    events = events_at(np.arange(40) * 50)
    packed, sender = sent_in_parts(events, RawSettings(EVENTS, EPOCH), 1)
    frames = [p.frame for p in packed]
    frames[3], frames[4] = frames[4], frames[3]
    receiver = RawReceiver(EVENTS, EPOCH)
    got = np.concatenate([receiver.push(frame) for frame in frames])
    tell(receiver, sender.epoch(100_000, 0))
    assert np.array_equal(np.sort(got, order="t"), events)
    assert receiver.counters.lost == 0
    assert receiver.counters.gaps == 3


def test_what_was_dropped_before_it_could_be_sent_is_told():
    sender, receiver = RawSender(RawSettings(EVENTS, EPOCH)), RawReceiver(EVENTS, EPOCH)
    for now_us, dropped in ((0, 0), (10_000, 70_000), (20_000, 70_001)):
        tell(receiver, sender.epoch(now_us, dropped))
    assert receiver.counters.dropped == (70_001 & 0xFFFF)
    assert sender.epoch(20_001, 0) == []


def test_events_without_an_epoch_have_no_time():
    receiver = RawReceiver(EVENTS, EPOCH)
    assert len(receiver.push(Frame(EVENTS, bytes(8)))) == 0
    assert receiver.counters.before_epoch == 1


@given(st.lists(st.tuples(st.sampled_from([EVENTS, EPOCH, 0x7FF]), st.binary(max_size=8))), st.binary(max_size=64))
def test_foreign_bytes_hurt_nobody(frames, fd_data):
    receiver = RawReceiver(EVENTS, EPOCH)
    for identifier, data in frames:
        assert len(receiver.push(Frame(identifier, data))) <= 2
    with suppress(RawError):
        assert len(unpack_fd_events(fd_data, 1, 0).events) <= 19


def test_a_frame_without_a_second_event_has_no_bits_for_one():
    word = 7 | 127 << 19 | 1 << 45
    with pytest.raises(RawError):
        unpack_events(word.to_bytes(8, "little"), 1, 0)


def test_larger_sensors_are_refused():
    with pytest.raises(RawError, match="blocks"):
        pack_events(made((0, 512, 0, True)), 1, 0)
    with pytest.raises(RawError, match="blocks"):
        pack_fd_events(made((0, 0, 512, True)), 1, 0)


@given(st.integers(0, 1 << 40), st.integers(-(1 << 15), (1 << 15) - 1))
def test_the_nearest_time_is_taken(near, away):
    t = near + away
    if t >= 0:
        assert unwrapped(t & 0xFFFF, 16, near) == t


def test_settings_say_what_is_wrong():
    with pytest.raises(ValueError, match="tick_us"):
        RawSettings(EVENTS, EPOCH, tick_us=7)
    with pytest.raises(ValueError, match="epoch_us"):
        RawSettings(EVENTS, EPOCH, epoch_us=30_000)
