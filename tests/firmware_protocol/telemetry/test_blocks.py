"""Blocks: what is decoded is what was encoded, by our decoder and by an independent one, in the fewest bytes."""

import numpy as np
import pytest
import slow_decoder
from block_strategies import TICKS, blocks_of, events_of, in_order, stream, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, empty_events, make_edges
from firmware_protocol.telemetry.layout import Mode
from firmware_protocol.telemetry.reading import as_received, decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings, write_block

MODES = ["smallest", "flat", "rows", "bitmap"]


def check(size, events, chosen):
    """Encode all events, decode with both decoders, and compare; returns the blocks."""
    blocks = blocks_of(BlockEncoder(size, chosen), events)
    for data, taken in blocks:
        near_us = int(taken["t"][0]) + 2**30
        block = decode_block(data, near_us)
        expected = in_order(taken, chosen.tick_us)
        assert np.array_equal(block.events, expected)
        assert np.array_equal(as_received(taken, chosen.tick_us), expected)
        assert (block.header.size, block.header.tick_us, block.header.dropped, len(block.edges)) == (
            size,
            chosen.tick_us,
            0,
            0,
        )
        assert chosen.mode == "smallest" or block.header.mode.name == chosen.mode.upper()
        assert len(data) <= chosen.max_bytes
        assert len(taken) <= chosen.max_events
        header, rows = slow_decoder.decode(data, near_us)
        assert np.array_equal(events_of(*rows), expected)
        assert header["mode"] == block.header.mode.name
    return [data for data, _ in blocks]


@given(streams(), st.sampled_from(TICKS), st.sampled_from(MODES), st.sampled_from([32, 200, 1024]))
def test_blocks_decode_to_what_they_were_made_of(drawn, tick_us, mode, max_bytes):
    size, events = drawn
    check(size, events, BlockSettings(tick_us, mode, max_events=100, max_bytes=max_bytes))


@given(streams(), st.sampled_from(TICKS))
def test_the_chosen_mode_is_the_smallest(drawn, tick_us):
    size, events = drawn
    taken, sizes = {}, {}
    for mode in MODES:
        encoder = BlockEncoder(size, BlockSettings(tick_us, mode, max_bytes=65535))
        data, taken[mode] = encoder.encode(events)
        sizes[mode] = len(data)
    same = [mode for mode in MODES if taken[mode] == taken["smallest"]]
    assert sizes["smallest"] == min(sizes[mode] for mode in same)


def test_a_full_picture_at_one_time_is_a_bitmap():
    y, x = np.divmod(np.arange(65_535), 346)
    events = empty_events(65_535)
    events["t"], events["x"], events["y"] = 5_000_000_000, x, y
    encoder = BlockEncoder((346, 260), BlockSettings(max_events=65_535, max_bytes=65_535))
    data, taken = encoder.encode(events)
    assert (taken, len(data)) == (65_535, 21)
    assert np.array_equal(decode_block(data, 5_000_000_000).events, events)
    events["on"] = np.random.default_rng(1).integers(0, 2, len(events))
    data, taken = encoder.encode(events)
    block = decode_block(data, 5_000_000_000)
    assert (taken, block.header.mode) == (65_535, Mode.BITMAP)
    assert len(data) < 65_535 / 8 + 24
    assert np.array_equal(block.events, events)


def test_runs_without_gaps_are_solid_spans():
    """Runs of 14 with gaps of 6: joined over the gaps they would cost a bit for each pixel."""
    at = np.flatnonzero(np.arange(346 * 100) % 20 < 14)
    events = empty_events(len(at))
    events["x"], events["y"], events["on"] = at % 346, at // 346, True
    data, taken = BlockEncoder((346, 260), BlockSettings(max_events=65_535, max_bytes=65_535)).encode(events)
    assert taken == len(events)
    assert 8 * len(data) < 0.75 * len(events)
    assert np.array_equal(decode_block(data).events, events)


@pytest.mark.parametrize("mode", ["rows", "bitmap"])
def test_the_largest_block(mode):
    events = stream((346, 260), 65_535, 30_000, 3)
    data, taken = BlockEncoder((346, 260), BlockSettings(1, mode, 65_535, 65_535)).encode(events)
    assert 0.9 * 65_535 < len(data) <= 65_535
    assert np.array_equal(decode_block(data).events, as_received(events[:taken], 1))


@pytest.mark.parametrize("mode", ["rows", "bitmap"])
def test_steps_around_the_escape(mode):
    """A dense burst makes k small, so that steps of 16 << k and beyond are escapes, up to the longest time."""
    near = [(1000, x, 3, 1) for x in range(0, 200, 2)]
    for far in range(20, 70):
        check((346, 260), events_of(*near, (1000, 198 + far, 3, 0)), BlockSettings(1, mode))
    check((346, 260), events_of(*near, (1000 + 2**31 - 1, 0, 0, 0)), BlockSettings(1, mode))


def test_a_block_spans_less_than_2_31_us():
    events = events_of((10, 1, 1, 1), (10 + 2**31 - 1, 2, 2, 1), (10 + 2**31, 3, 3, 0))
    data, taken = BlockEncoder((346, 260)).encode(events)
    assert taken == 2
    assert np.array_equal(decode_block(data).events, events[:2])
    data, taken = BlockEncoder((346, 260), BlockSettings(1000)).encode(events)
    assert taken == 1  # in ticks the block starts at 0
    events["t"] -= 10
    data, taken = BlockEncoder((346, 260), BlockSettings(1000)).encode(events)
    assert decode_block(data).events["t"].tolist() == [0, 2_147_483_000]


@given(st.integers(0, 2**50), st.integers(-(2**31), 2**31 - 1))
def test_time_is_completed_by_any_time_within_half_the_range(t_us, off_us):
    near_us = t_us + off_us
    data, _ = BlockEncoder((346, 260)).encode(events_of((t_us, 1, 2, 1)))
    if near_us >= 0:
        assert int(decode_block(data, near_us).events["t"][0]) == t_us or abs(off_us) == 2**31


def test_a_cheap_burst_before_a_dear_tail_fills_a_block_too():
    """The guess of how many events fit is wrong here by a factor of ten, both ways."""
    y, x = np.divmod(np.arange(20_000), 346)
    burst = empty_events(20_000)
    burst["x"], burst["y"] = x, y
    events = np.concatenate([burst, stream((346, 260), 40_000, 10**9, 2, 1000)])
    encoder = BlockEncoder((346, 260), BlockSettings(max_events=65_535, max_bytes=2000))
    data, taken = encoder.encode(events)
    assert taken > 20_000
    assert 0.9 * 2000 < len(data) <= 2000
    assert np.array_equal(decode_block(data).events, as_received(events[:taken], 1))


@pytest.mark.parametrize("span_us", [2_000, 50_000, 2_000_000])
@pytest.mark.parametrize("max_bytes", [128, 1024, 4000])
def test_blocks_are_filled(span_us, max_bytes):
    events = stream((346, 260), 5000, span_us, 1)
    encoder = BlockEncoder((346, 260), BlockSettings(max_bytes=max_bytes))
    assert min([len(data) for data, _ in blocks_of(encoder, events)][:-1]) > 0.9 * max_bytes


def test_dropped_is_told_and_saturates():
    encoder = BlockEncoder((346, 260))
    for dropped, told in ((0, 0), (7, 7), (65_535, 65_535), (10**9, 65_535)):
        data, _ = encoder.encode(events_of((1, 1, 1, 1)), dropped)
        assert decode_block(data).header.dropped == told


def test_no_events_make_a_block_that_only_tells_what_was_dropped():
    data, taken = BlockEncoder((346, 260)).encode(empty_events(), 9)
    block = decode_block(data)
    assert (len(data), taken, len(block.events), block.header.dropped) == (14, 0, 0, 9)
    assert slow_decoder.decode(data)[1] == []


def test_special_arrays_are_taken_too_without_compiling_again():
    events = stream((346, 260), 200, 1000, 4)
    encoder = BlockEncoder((346, 260))
    encoder.encode(events)
    compiled = len(write_block.signatures)
    locked = events.copy()
    locked.flags.writeable = False
    for special in (events[::2], locked, events[::-1][::-1]):
        data, taken = encoder.encode(special)
        assert np.array_equal(decode_block(data).events, in_order(special[:taken], 1))
    assert len(write_block.signatures) == compiled


@given(
    st.lists(
        st.tuples(st.integers(0, 2**31 - 1), st.integers(2, 4), st.integers(0, 255), st.integers(0, 65535)),
        min_size=1,
        max_size=20,
    ),
    st.integers(0, 2**45),
)
def test_edges_come_back(rows, start_us):
    edges = np.array(rows, EDGE)
    edges["t"] = start_us + np.sort(edges["t"])
    data = BlockEncoder((346, 260), BlockSettings(tick_us=1000)).encode_edges(edges, 3)
    block = decode_block(data, start_us)
    assert np.array_equal(block.edges, edges)
    assert (block.header.mode, block.header.tick_us, block.header.dropped, len(block.events)) == (Mode.EDGE, 1, 3, 0)
    assert np.array_equal(np.array(slow_decoder.decode(data, start_us)[1], EDGE), edges)


def test_edges_that_make_no_block_are_refused():
    encoder = BlockEncoder((346, 260), BlockSettings(max_bytes=40))
    assert encoder.max_edges == 3
    for times, kind in (([], 2), ([1, 2, 3, 4], 2), ([2, 1], 2), ([0, 2**31], 2), ([1], 5)):
        edges = make_edges(times, kind)
        with pytest.raises(ValueError, match="edge"):
            encoder.encode_edges(edges)


@pytest.mark.parametrize(
    ("events", "complaint"),
    [
        (events_of((1, 346, 0, 1)), "346 x 260"),
        (events_of((1, 0, 0, 1), (2, 0, 260, 1)), "346 x 260"),
        (events_of((2, 0, 0, 1), (1, 0, 0, 1)), "back in time"),
        (events_of((2**63, 0, 0, 1)), "back in time"),
    ],
)
def test_events_that_are_no_stream_of_the_sensor_are_refused(events, complaint):
    for mode in MODES:
        with pytest.raises(ValueError, match=complaint):
            BlockEncoder((346, 260), BlockSettings(mode=mode)).encode(events)


@pytest.mark.parametrize(
    "wrong",
    [
        {"tick_us": 2},
        {"mode": "edge"},
        {"max_events": 0},
        {"max_events": 65536},
        {"max_bytes": 31},
        {"max_bytes": 65536},
    ],
)
def test_settings_that_no_block_can_have_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        BlockSettings(**wrong)


@pytest.mark.parametrize("size", [(0, 1), (1, 4097)])
def test_sizes_that_no_block_can_have_are_refused(size):
    with pytest.raises(ValueError, match="size"):
        BlockEncoder(size)


def test_streams_too_long_to_put_in_order_at_once_are_refused():
    with pytest.raises(ValueError, match="ticks"):
        as_received(events_of((0, 1, 1, 1), (2**32, 1, 1, 1)), 1)
    assert len(as_received(empty_events(), 1)) == 0
