"""Raw CAN frames in C: the same events and the same counts as the Python receiver."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from raw_strategies import frames_of, jumping_streams

from firmware_protocol.can_frames.dbc import Identifiers
from firmware_protocol.can_frames.frame import FD_LENGTHS, Frame
from firmware_protocol.can_frames.raw_events import pack_marks
from firmware_protocol.can_frames.raw_stream import RawReceiver, RawSender, RawSettings
from firmware_protocol.events import EDGE, EVENT, empty_events
from tests.made_events import events_at

IDS = Identifiers.of_node(0x22)
EVENTS, EPOCH = IDS.events, IDS.epoch
CLOCK = IDS.clock
COUNTERS = ("lost", "dropped", "gaps", "repeated", "before_epoch", "malformed")


@st.composite
def streams(draw, most=60):
    gaps = draw(st.lists(st.sampled_from([0, 1, 30, 31, 126, 127, 5_000, 40_000, 2_000_000]), max_size=most))
    rng = np.random.default_rng(draw(st.integers(0, 99)))
    events = events_at(np.cumsum([draw(st.integers(0, 1 << 33)), *gaps])[1:])
    events["x"], events["y"], events["on"] = rng.integers(0, [512, 512, 2], (len(gaps), 3)).T
    return events


def request(frames):
    return b"".join(struct.pack("<HBB", f.identifier, f.fd, len(f.data)) + f.data for f in frames)


def same_as_python(library, frames):
    receiver = RawReceiver(EVENTS, EPOCH, CLOCK)
    events = np.concatenate([empty_events(), *(receiver.push(frame) for frame in frames)])
    reply = library("n", request(frames), size=(512, 512))
    assert np.array_equal(reply.events, events)
    expected = [getattr(receiver.counters, name) & 0xFFFFFFFF for name in COUNTERS]
    assert reply.counters == [len(events), 0, 0, *expected]
    return reply


@given(streams(), st.sampled_from([1, 10, 100, 1000]), st.integers(1, 4), st.booleans())
def test_events_come_back(library, events, tick_us, parts, fd):
    sender = RawSender(RawSettings(EVENTS, EPOCH, tick_us, fd=fd))
    frames = [p.frame for i, part in enumerate(np.array_split(events, parts)) for p in sender.pack(part, dropped=3 * i)]
    assert np.array_equal(same_as_python(library, frames).events[["x", "y", "on"]], events[["x", "y", "on"]])


@given(jumping_streams(), st.booleans(), st.integers(0, 40))
def test_times_are_exact_far_from_zero_over_jumps_and_for_late_joiners(library, parts, fd, joins):
    frames, expected = frames_of(parts, fd=fd)
    assert np.array_equal(same_as_python(library, frames).events, np.concatenate(expected))
    same_as_python(library, frames[joins:])


@given(streams(), st.booleans(), st.data())
def test_lost_repeated_and_late_frames_count_the_same(library, events, fd, data):
    sender = RawSender(RawSettings(EVENTS, EPOCH, fd=fd))
    frames = [p.frame for part in np.array_split(events, 5) for p in sender.pack(part)]
    if frames:
        frames = data.draw(st.lists(st.sampled_from(frames), max_size=30)) + frames[1::2]
    same_as_python(library, frames)


FD_DATA = st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))
ANY = st.one_of(
    st.builds(Frame, st.sampled_from([EVENTS, EPOCH, CLOCK, 0x7FF]), st.binary(max_size=8)),
    st.builds(lambda d: Frame(EVENTS, d, fd=True), FD_DATA),
    st.builds(
        lambda head, n, cells: Frame(EVENTS, (head + bytes([n, 0]) + cells).ljust(64, b"\0")[:64], fd=True),
        st.binary(min_size=5, max_size=5), st.integers(17, 20), st.binary(max_size=60),
    ),
)  # fmt: skip


@given(st.lists(ANY, max_size=30), st.booleans())
def test_any_frames_count_the_same(library, frames, timed):
    same_as_python(library, [Frame(EPOCH, bytes(8))] * timed + frames)


def test_a_pixel_outside_the_sensor_spoils_its_frame(library):
    events = np.array([(5, 345, 259, True), (6, 346, 0, True), (7, 0, 260, False), (8, 0, 0, False)], EVENT)
    for fd in (False, True):
        sender = RawSender(RawSettings(EVENTS, EPOCH, fd=fd))
        frames = [p.frame for event in events for p in sender.pack(event[None])]
        reply = library("n", request(frames), size=(346, 260))
        assert reply.events.tolist() == [events[0].item(), events[3].item()]
        assert reply.counters[-1] == 2


def test_edges_and_marks_are_kept_apart(library):
    edges = np.array([(2**31 + 5, 2, 0, 1), (2**31 + 9, 3, 1, 65535), (2**31 + 10, 4, 9, 0)], EDGE)
    data = pack_marks(edges)
    epoch = Frame(EPOCH, struct.pack("<IHH", 2**30 - 1, 0, 0))
    frames = [epoch, *(Frame(IDS.edges, d) for d in data), Frame(IDS.marks, data[0]), Frame(IDS.edges, bytes(8))]
    reply = library("n", request(frames))
    assert np.array_equal(reply.edges, edges)
    assert reply.frames == [edges[:1].tobytes()]
    assert (reply.counters[1], reply.counters[2], reply.counters[-1]) == (3, 1, 1)


@pytest.mark.parametrize(("step", "bound"), [(32767, 2**31 - 1), (-32768, -(2**31))])
def test_the_count_of_lost_events_stays_at_the_bounds_of_an_int32(library, step, bound):
    """An epoch frame tells of 32767 events at most, so that 65 540 of them exceed the counter."""
    sent = (step * np.arange(65_600, dtype=np.int64)) & 0xFFFF
    frames = [Frame(EPOCH, struct.pack("<IHH", k, int(n), 0)) for k, n in enumerate(sent)]
    reply = library("n", request(frames))
    assert reply.counters[3] == bound & 0xFFFFFFFF
    assert reply.counters[-1] == 0
    inwards = -1000 if step > 0 else 1000
    back = [*frames, Frame(EPOCH, struct.pack("<IHH", 0, (int(sent[-1]) + inwards) & 0xFFFF, 0))]
    assert library("n", request(back)).counters[3] == (bound + inwards) & 0xFFFFFFFF


@pytest.mark.parametrize("cells", [19, 20, 27, 255])
def test_a_frame_longer_than_any_is_refused(library, cells):
    epoch = struct.pack("<HBB", EPOCH, 0, 8) + bytes(8)
    length = (7 + 3 * cells + 15) // 16 * 16 & 255
    reply = library("n", epoch + struct.pack("<HBB", EVENTS, 1, length) + bytes([0] * 5 + [cells] + [0] * (length - 6)))
    assert (len(reply.events), reply.counters[-1]) == ((19, 0) if cells == 19 else (0, 1))
