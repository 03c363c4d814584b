"""The external input: detectors, generator, marks among the events, and the fate of every edge."""

import dataclasses

import numpy as np
import pytest
from davis_host import RUN, STOP, Host, events_of, steady
from davis_strategies import STEPS_US, cut, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.davis346.words import WordEncoder
from firmware_protocol.device.fates import Counts
from firmware_protocol.events import EdgeKind, empty_events, make_edges
from firmware_protocol.fx3.words import GENERATOR_FALLING, GENERATOR_RISING, MARK, WordState

RISING, FALLING, PULSE = EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.PULSE
RISING_CODE, FALLING_CODE, PULSE_CODE = 3, 2, 4
LOGIC_MHZ = 104
DETECT = [(4, 1, 0), (4, 2, 0), (4, 3, 0), (4, 0, 1)]
"""The detector runs, and tells of nothing."""


def edges_of(*rows):
    """Edges from (t, kind) pairs."""
    return make_edges([t for t, _ in rows], [kind for _, kind in rows])


def marks_of(*rows):
    return np.array(list(rows), MARK)


def listening(*kinds, length_us=10, **changes):
    """A camera that streams from time zero and tells of edges of `kinds`, and its host."""
    settings = dataclasses.replace(Davis346Settings(start_delay_us=0), **changes)
    host = Host(Davis346(settings))
    host.write_all([*RUN, *DETECT, (4, 5, length_us * LOGIC_MHZ)])
    host.write_all([(4, {RISING: 1, FALLING: 2, PULSE: 3}[kind], 1) for kind in kinds])
    return host.camera, host


def told(host):
    """All edges that the host can decode now, as (t, kind)."""
    return [(int(e["t"]), int(e["kind"])) for e in host.decoded().edges]


def balanced(edges):
    return edges.accounted == edges.offered + edges.added and min(dataclasses.astuple(edges)) >= 0


# --- words


def test_golden_words_of_marks_among_events():
    events = events_of((5, 3, 7, True), (9, 4, 7, False))
    marks = marks_of((2, RISING_CODE), (5, PULSE_CODE), (7, FALLING_CODE), (32768, RISING_CODE))
    words = WordEncoder((346, 260)).encode(events, 0, marks).words
    assert words.tolist() == [
        0x8002, 0x0003, 0x8005, 0x0004, 0x1007, 0x3003, 0x8007, 0x0002, 0x8009, 0x2004, 0x7001, 0x0003,
    ]  # fmt: skip


def test_marks_alone_and_marks_before_the_first_row():
    encoder = WordEncoder((346, 260))
    assert encoder.encode(empty_events(), 0, marks_of((0, RISING_CODE), (0, PULSE_CODE))).words.tolist() == [3, 4]
    assert encoder.state == WordState(0, -1)
    assert encoder.encode(events_of((0, 1, 2, True))).words.tolist() == [0x1002, 0x3001]


@pytest.mark.parametrize("count", [1, 20_000])
def test_marks_over_several_blocks_of_events_stay_in_order(count):
    events = steady(40_000)
    times = np.sort(np.random.default_rng(1).integers(0, 40_000, count))
    marks = np.zeros(count, MARK)
    marks["t"], marks["code"] = times, RISING_CODE
    decoded = Decoder().feed(WordEncoder((346, 260)).encode(events, 0, marks).words.tobytes())
    assert np.array_equal(decoded.events, events)
    assert np.array_equal(decoded.edges["t"], times)
    assert np.array_equal(decoded.specials["index"], np.searchsorted(events["t"], times))


def test_marks_that_go_back_in_time_are_refused():
    with pytest.raises(ValueError, match="sorted"):
        WordEncoder().encode(empty_events(), 0, marks_of((9, RISING_CODE), (8, RISING_CODE)))


BEGINS_US = st.sampled_from([0, (1 << 31) - 50_000, (1 << 32) - 50_000])


@given(streams(max_size=30), st.lists(STEPS_US, max_size=20), st.lists(st.integers(0, 200), max_size=4), BEGINS_US)
def test_events_and_marks_interleaved_come_back(events, steps, cuts, begin_us):
    events["t"] += np.uint64(begin_us)
    marks = np.zeros(len(steps), MARK)
    marks["t"] = begin_us + np.cumsum(np.array(steps, np.int64))
    marks["code"] = np.resize([RISING_CODE, FALLING_CODE, PULSE_CODE], len(steps))
    data = WordEncoder((346, 260)).encode(events, 0, marks).words.tobytes()
    decoder = Decoder((346, 260))
    parts = [decoder.feed(part) for part in cut(data, cuts)]
    assert np.array_equal(np.concatenate([part.events for part in parts]), events)
    edges = np.concatenate([part.edges for part in parts])
    assert edges["t"].tolist() == marks["t"].tolist()
    assert edges["kind"].tolist() == [{3: RISING, 2: FALLING, 4: PULSE}[c] for c in marks["code"].tolist()]
    assert decoder.faults.total == 0


# --- detectors


@pytest.mark.parametrize(
    ("kinds", "expected"),
    [
        ((RISING,), [(100, RISING)]),
        ((FALLING,), [(200, FALLING)]),
        ((PULSE,), [(110, PULSE)]),
        ((RISING, FALLING, PULSE), [(100, RISING), (110, PULSE), (200, FALLING)]),
        ((), []),
    ],
)
def test_a_pulse_is_told_as_the_registers_want_it(kinds, expected):
    camera, host = listening(*kinds, pulse_us=100)
    camera.offer_edges(edges_of((100, PULSE)))
    camera.advance(1000)
    assert told(host) == expected
    edges = camera.counters.edges
    assert edges.ignored == (not expected)
    assert edges.added == max(0, len(expected) - 1)
    assert balanced(edges)


def test_a_detector_that_does_not_run_ignores():
    camera, host = listening(RISING)
    host.write(4, 0, 0)
    camera.offer_edges(edges_of((100, RISING)))
    camera.advance(1000)
    assert told(host) == []
    assert camera.counters.edges == Counts(offered=1, ignored=1)


def test_a_camera_that_does_not_run_ignores():
    camera, host = listening(RISING)
    host.write_all(STOP)
    camera.offer_edges(edges_of((100, RISING)))
    camera.advance(1000)
    assert camera.counters.edges == Counts(offered=1, ignored=1)


def test_edges_during_the_silence_are_ignored():
    camera, host = listening(RISING, start_delay_us=500)
    camera.offer_edges(edges_of((499, RISING), (500, RISING)))
    camera.advance(1000)
    assert told(host) == [(500, RISING)]
    assert camera.counters.edges.ignored == 1


@pytest.mark.parametrize(("width", "seen"), [(9, []), (10, [(110, PULSE)]), (11, [(110, PULSE)])])
def test_a_pulse_must_last(width, seen):
    camera, host = listening(PULSE)
    camera.offer_edges(edges_of((100, RISING), (100 + width, FALLING)))
    camera.advance(1000)
    assert told(host) == seen
    assert camera.counters.edges.ignored == 2 - len(seen)


def test_a_low_pulse_is_told_where_its_polarity_is_chosen():
    camera, host = listening(PULSE)
    host.write(4, 4, 0)
    camera.offer_edges(edges_of((100, RISING), (200, FALLING), (250, RISING)))
    camera.advance(1000)
    assert told(host) == [(210, PULSE)]


def test_an_edge_of_the_past_is_stamped_now():
    camera, host = listening(RISING, FALLING, PULSE, pulse_us=50)
    camera.offer(steady(1000))
    camera.offer_edges(edges_of((100, PULSE)))
    camera.offer(events_of((999, 1, 1, True), (2000, 1, 1, True)))
    assert told(host) == [(999, RISING), (1009, PULSE), (1049, FALLING)]
    assert host.decoder.faults.total == 0


def test_power_on_values_are_those_of_the_published_logic():
    host = Host(Davis346())
    assert [host.read(4, k) for k in range(6)] == [0, 0, 0, 1, 1, LOGIC_MHZ]
    assert [host.read(4, k) for k in range(10, 17)] == [1, 0, 1, LOGIC_MHZ, LOGIC_MHZ // 2, 0, 0]


@given(st.lists(st.tuples(STEPS_US, st.sampled_from(list(EdgeKind))), max_size=15), st.lists(STEPS_US, max_size=6))
def test_marks_do_not_depend_on_how_time_is_cut(changes, steps):
    times = np.cumsum(np.array([step for step, _ in changes], np.int64))
    edges = edges_of(*((t, kind) for t, (_, kind) in zip(times.tolist(), changes, strict=True)))
    end = int(times[-1]) + 1000 if len(times) else 1000
    whole, host = listening(RISING, FALLING, PULSE)
    whole.offer_edges(edges)
    whole.advance(end)
    expected = told(host)
    pieces, host = listening(RISING, FALLING, PULSE)
    at = 0
    for now in [*np.minimum(np.cumsum(np.array(steps, np.int64)), end).tolist(), end]:
        upto = int(np.searchsorted(edges["t"], now, side="right"))
        pieces.offer_edges(edges[at:upto])
        pieces.advance(now)
        at = upto
    assert told(host) == expected
    assert balanced(pieces.counters.edges)
    assert pieces.counters.edges == whole.counters.edges


# --- generator


def generating(interval_us, length_us, rising=1, falling=1, polarity=1):
    host = Host(Davis346(Davis346Settings(start_delay_us=0)))
    host.write_all(RUN)
    host.camera.advance(1000)
    host.write_all([(4, 12, polarity), (4, 13, interval_us * LOGIC_MHZ), (4, 14, length_us * LOGIC_MHZ)])
    host.write_all([(4, 15, rising), (4, 16, falling), (4, 11, 1)])
    return host.camera, host


@pytest.mark.parametrize("step", [1, 7, 10, 1000])
def test_the_generator_tells_of_its_edges_however_time_is_cut(step):
    camera, host = generating(10, 4)
    for now in range(1000, 1036 + step, step):
        camera.advance(min(now, 1036))
    expected = [(1010, GENERATOR_RISING), (1014, GENERATOR_FALLING)]
    expected += [(1020, GENERATOR_RISING), (1024, GENERATOR_FALLING)]
    expected += [(1030, GENERATOR_RISING), (1034, GENERATOR_FALLING)]
    assert told(host) == expected
    assert camera.counters.edges == Counts(delivered=6, added=6)


def test_the_generator_tells_what_is_asked_and_by_its_polarity():
    camera, host = generating(10, 4, falling=0, polarity=0)
    camera.advance(1025)
    assert told(host) == [(1014, GENERATOR_RISING), (1024, GENERATOR_RISING)]


@pytest.mark.parametrize(("interval", "length"), [(0, 0), (10, 0), (10, 10), (4, 10)])
def test_a_generator_whose_output_never_changes_is_silent(interval, length):
    camera, host = generating(interval, length)
    camera.advance(100_000)
    assert told(host) == []


def test_a_generator_at_its_clock_tells_once_a_microsecond():
    camera, host = generating(1, 1)
    host.write_all([(4, 11, 0), (4, 13, 2), (4, 14, 1), (4, 16, 0), (4, 11, 1)])
    camera.advance(1003)
    assert told(host) == [(t, GENERATOR_RISING) for t in (1000, 1001, 1002, 1003)][1:]


# --- a full FIFO


def filled(drop):
    camera, host = listening(RISING, fifo_bytes=1024)
    host.write(0, 4, drop)
    camera.offer(steady(1000, seed=3))  # fills the FIFO to its last word
    camera.offer_edges(edges_of(*((2000 + 10 * k, RISING) for k in range(20))))
    camera.advance(3000)
    return camera, host


def test_marks_are_dropped_on_a_stall_and_counted():
    camera, host = filled(drop=1)
    assert camera.counters.edges == Counts(offered=20, dropped_fifo=20)
    assert (host.read(0, 81), host.read(0, 82)) == (0, 20)
    assert told(host) == []


def test_marks_wait_out_a_stall_and_are_stamped_late_where_the_host_wants_that():
    camera, host = filled(drop=0)
    assert camera.counters.edges == Counts(offered=20, dropped_fifo=12, queued=8)
    host.decoded()
    camera.advance(5000)
    assert told(host) == [(3000, RISING)] * 8
    assert host.decoder.faults.total == 0
    assert balanced(camera.counters.edges)


def test_marks_that_wait_are_dropped_with_the_power():
    camera, _ = filled(drop=0)
    camera.detached()
    assert camera.counters.edges == Counts(offered=20, dropped_fifo=20)


def test_marks_survive_events_that_are_refused():
    camera, host = listening(RISING)
    camera.offer_edges(edges_of((5, RISING)))
    with pytest.raises(ValueError, match="outside"):
        camera.offer(events_of((9, 400, 1, True)))
    camera.offer(events_of((9, 40, 1, True)))
    assert told(host) == [(5, RISING)]
