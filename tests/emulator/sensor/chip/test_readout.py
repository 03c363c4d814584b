"""The arbiter: order, times, losses, and independence of how crossings are cut into calls."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.sensor.chip.readout import ArbiterReadOut
from emulator.sensor.parameters import ResetParameters
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.presets import PRESETS, ReadoutParameters
from firmware_protocol.events import EVENT


def sensor(width=70, height=67, event_ns=80.0, row_ns=100, **changes):
    readout = ReadoutParameters(event_ns=event_ns, row_ns=row_ns)
    return dataclasses.replace(PRESETS["davis346"], width=width, height=height, readout=readout, **changes)


def busy_sensor(refractory_us, **changes):
    return sensor(refractory_us=refractory_us, reset=ResetParameters(at_acknowledge=True), **changes)


def crossings(rows, width=70):
    """From [(t_ns, x, y, on)], sorted by time, on a sensor of `width` columns."""
    t, x, y, on = (np.array(column) for column in zip(*rows, strict=True)) if rows else (np.empty(0),) * 4
    return Crossings(t.astype(np.int64), (y * width + x).astype(np.uint32), on.astype(np.bool_))


def part(c, first, last):
    return Crossings(c.t_ns[first:last], c.pixel[first:last], c.on[first:last])


def plain_arbiter(rows, parameters):
    """The same rules, written for reading: [(exit_ns, x, y, on)] and the number lost."""
    waiting, free, last, out, lost = {}, 0, parameters.height - 1, [], 0
    busy, wait_ns = {}, round(parameters.refractory_us * 1000) if parameters.reset.at_acknowledge else None
    event_ps, row_ns = round(parameters.readout.event_ns * 1000), parameters.readout.row_ns
    queue = list(rows)

    def admit(until):
        nonlocal lost
        while queue and queue[0][0] <= until:
            t, x, y, on = queue.pop(0)
            if (y, x) in waiting or t < busy.get((y, x), 0):
                lost += 1
            else:
                waiting[y, x] = on

    while queue or waiting:
        admit(free)
        if queue and not waiting:
            free = max(free, queue[0][0])
            admit(free)
        if not waiting:
            continue
        row = min({y for y, _ in waiting}, key=lambda y: (y - last - 1) % parameters.height)
        latch = free + row_ns
        admit(latch)
        taken = sorted(x for y, x in waiting if y == row)
        if wait_ns is not None:
            busy |= {(row, x): latch + wait_ns for x in taken}
        for k, x in enumerate(taken):
            out.append((latch - (-(k + 1) * event_ps // 1000), x, row, waiting.pop((row, x))))
        free, last = latch - (-len(taken) * event_ps // 1000), row
    return out, lost


bursts = st.lists(
    st.tuples(st.integers(0, 3000), st.integers(0, 69), st.integers(60, 66), st.booleans()), max_size=80
).map(sorted)


@given(rows=bursts, event_ns=st.sampled_from([0.94, 2.2, 80.0]), row_ns=st.sampled_from([0, 30, 100]))
def test_it_does_what_the_plain_arbiter_does(rows, event_ns, row_ns):
    parameters = sensor(event_ns=event_ns, row_ns=row_ns)
    expected, lost = plain_arbiter(rows, parameters)
    readout = ArbiterReadOut(parameters)
    events = np.concatenate([readout.push(crossings(rows), 3000), readout.finish()])
    assert events.tolist() == [(t // 1000, x, y, on) for t, x, y, on in expected]
    assert (readout.raised, readout.lost_at_readout, readout.read_out, readout.pending) == (
        len(rows), lost, len(rows) - lost, 0,
    )  # fmt: skip


wide_bursts = st.lists(
    st.tuples(
        st.integers(0, 3000), st.sampled_from([0, 63, 64, 127, 128, 4095, 4096, 8999]), st.integers(0, 2), st.booleans()
    ),
    max_size=80,
).map(sorted)


@given(rows=wide_bursts)
def test_rows_of_more_than_64_words_are_served_the_same(rows):
    parameters = sensor(width=9000, height=3, event_ns=2.2, row_ns=30)
    expected, lost = plain_arbiter(rows, parameters)
    readout = ArbiterReadOut(parameters)
    events = np.concatenate([readout.push(crossings(rows, 9000), 3000), readout.finish()])
    assert events.tolist() == [(t // 1000, x, y, on) for t, x, y, on in expected]
    assert readout.lost_at_readout == lost


@given(rows=bursts, cuts=st.lists(st.integers(0, 4000), max_size=6).map(sorted))
def test_how_crossings_are_cut_into_calls_does_not_matter(rows, cuts):
    whole, cut = ArbiterReadOut(sensor()), ArbiterReadOut(sensor())
    c = crossings(rows)
    expected = np.concatenate([whole.push(c, 4000), whole.finish()])
    got, first = [], 0
    for until in [*cuts, 4000]:
        last = int(np.searchsorted(c.t_ns, until, side="left" if until % 2 else "right"))
        got.append(cut.push(part(c, first, last), until))
        first = last
        assert np.all(got[-1]["t"] * 1000 < max(until, 1))
        assert cut.raised == cut.lost_at_readout + cut.read_out + cut.pending
    got.append(cut.finish())
    assert np.concatenate(got).tobytes() == expected.tobytes()
    assert cut.lost_at_readout == whole.lost_at_readout


@given(rows=bursts, refractory_us=st.sampled_from([0.0, 0.05, 1.0]), row_ns=st.sampled_from([0, 100]))
def test_a_pixel_is_busy_from_its_acknowledge_on_as_in_the_plain_arbiter(rows, refractory_us, row_ns):
    parameters = busy_sensor(refractory_us, row_ns=row_ns)
    expected, lost = plain_arbiter(rows, parameters)
    readout = ArbiterReadOut(parameters)
    events = np.concatenate([readout.push(crossings(rows), 3000), readout.finish()])
    assert events.tolist() == [(t // 1000, x, y, on) for t, x, y, on in expected]
    assert (readout.raised, readout.lost_at_readout, readout.read_out) == (len(rows), lost, len(rows) - lost)
    assert readout._queue.busy <= lost


@given(rows=bursts, cuts=st.lists(st.integers(0, 4000), max_size=6).map(sorted))
def test_busy_pixels_do_not_depend_on_how_crossings_are_cut(rows, cuts):
    whole, cut = (ArbiterReadOut(busy_sensor(0.5)) for _ in range(2))
    c, first, got = crossings(rows), 0, []
    expected = np.concatenate([whole.push(c, 4000), whole.finish()])
    for until in [*cuts, 4000]:
        last = int(np.searchsorted(c.t_ns, until, side="left" if until % 2 else "right"))
        got.append(cut.push(part(c, first, last), until))
        first = last
        assert cut.raised == cut.lost_at_readout + cut.read_out + cut.pending
    assert np.concatenate([*got, cut.finish()]).tobytes() == expected.tobytes()
    assert (cut._queue.busy, cut.lost_at_readout) == (whole._queue.busy, whole.lost_at_readout)


def test_a_pixel_behind_a_full_bus_is_busy_from_its_acknowledge_on():
    """Row 1 waits for the 70 events of row 0: its pixel is acknowledged at 2 x 100 + 70 x 80 ns, and busy for 1000."""
    first = [(0, x, 0, True) for x in range(70)]
    later = [(50, 5, 1, True), (3000, 5, 1, True), (5790, 5, 1, False), (6799, 5, 1, True), (6800, 5, 1, False)]
    readout = ArbiterReadOut(busy_sensor(1.0))
    events = np.concatenate([readout.push(crossings(sorted(first + later)), 10_000), readout.finish()])
    assert readout.lost_at_readout == 3
    assert readout._queue.busy == 1
    assert [bool(on) for on in events[events["y"] == 1]["on"]] == [True, False]


def test_the_refractory_period_after_the_acknowledge_can_change():
    readout = ArbiterReadOut(busy_sensor(1.0))
    readout.push(crossings([(0, 3, 3, True)]), 500)
    readout.set_refractory(5.0)
    readout.push(crossings([(1090, 3, 3, True), (2000, 3, 3, True)]), 3000)  # the first period ends at 1100
    readout.push(crossings([(5000, 3, 3, True), (7200, 3, 3, True)]), 8000)  # the second one at 7100
    readout.finish()
    assert (readout._queue.busy, readout.read_out) == (2, 3)


def test_a_lone_event_leaves_after_a_row_and_an_event_time():
    readout = ArbiterReadOut(sensor(event_ns=900.0, row_ns=100))
    assert readout.push(crossings([(5000, 3, 4, True)]), 10_000).tolist() == [(6, 3, 4, True)]


def test_a_full_frame_leaves_at_the_rate_of_the_bus_and_loses_what_fires_again_meanwhile():
    parameters = PRESETS["davis346"]
    pixels = np.arange(346 * 260, dtype=np.uint32)
    both = Crossings(
        np.concatenate([np.zeros(pixels.size, np.int64), np.full(pixels.size, 3_600_000)]),
        np.concatenate([pixels, pixels]),
        np.ones(2 * pixels.size, np.bool_),
    )
    readout = ArbiterReadOut(parameters)
    events = np.concatenate([readout.push(both, 3_600_000), readout.finish()])
    frame_ns = 260 * (80 + 346 * 80)
    served = 3_600_000 // (80 + 346 * 80)  # rows latched when everything fires again: the rest is lost
    assert readout.lost_at_readout == pixels.size - (served + 1) * 346
    assert events["t"][pixels.size - 1] == frame_ns // 1000
    assert len(events) == pixels.size + (served + 1) * 346
    assert np.all(np.diff(events["t"].astype(np.int64)) >= 0)


def test_rows_take_turns():
    """A row that fires all the time does not keep another waiting for more than its own turn."""
    busy = [(t, t // 10 % 70, 5, True) for t in range(0, 20_000, 10)]
    rows = sorted([*busy, (1005, 1, 30, False)])
    readout = ArbiterReadOut(sensor())
    events = readout.push(crossings(rows), 20_000)
    assert events["t"][int(np.flatnonzero(events["y"] == 30)[0])] <= 1 + (2 * (100 + 70 * 80)) // 1000


def test_time_does_not_go_back():
    readout = ArbiterReadOut(sensor())
    readout.push(crossings([]), 1000)
    with pytest.raises(ValueError, match="time does not go back"):
        readout.push(crossings([]), 999)
    with pytest.raises(ValueError, match="must lie from"):
        readout.push(crossings([(999, 0, 0, True)]), 2000)
    with pytest.raises(ValueError, match="must lie from"):
        readout.push(crossings([(2001, 0, 0, True)]), 2000)
    assert readout.push(crossings([]), 1000).dtype == EVENT
