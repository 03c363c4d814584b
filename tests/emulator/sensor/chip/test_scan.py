"""The scanned read-out: one look per scan, compared with a slow one written from the rules."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.light import LightFrame
from emulator.sensor.chip.scan import ScanReadOut
from emulator.sensor.parameters import ResetParameters
from emulator.sensor.pixels.crossings import Crossings
from emulator.sensor.presets import PRESETS, ReadoutParameters
from emulator.sensor.sensor import Sensor

WIDTH, HEIGHT, SCAN_NS = 16, 6, 16_000
END_NS = 400_000


def parameters(event_ns=2.0, **changes):
    readout = ReadoutParameters(event_ns=event_ns, row_ns=0, scan_us=SCAN_NS / 1000)
    return dataclasses.replace(
        PRESETS["dvxplorer_micro"], **{"width": WIDTH, "height": HEIGHT, **changes}, readout=readout
    )


def crossings(times, pixels, ons):
    order = np.lexsort([pixels, times])
    return Crossings(np.array(times, np.int64)[order], np.array(pixels, np.uint32)[order], np.array(ons, bool)[order])


def slow(found, event_ns, busy_ns=None):
    """What the rules say, column by column with a dictionary of requests; and how many crossings are lost."""
    waiting, sent, lost, t, column, k = {}, [], 0, 0.0, 0, 0
    busy = {}
    events = list(zip(found.t_ns.tolist(), found.pixel.tolist(), found.on.tolist(), strict=True))
    while k < len(events) or waiting:
        while k < len(events) and events[k][0] <= int(t):
            at, pixel, on = events[k]
            is_lost = pixel in waiting or at < busy.get(pixel, 0)
            lost += is_lost
            waiting |= {} if is_lost else {pixel: on}
            k += 1
        here = sorted(pixel for pixel in waiting if pixel % WIDTH == column)
        sent += [(int(t) // 1000, pixel % WIDTH, pixel // WIDTH, waiting.pop(pixel)) for pixel in here]
        if busy_ns is not None:
            busy |= {pixel: int(t) + busy_ns for pixel in here}
        t += max(SCAN_NS / WIDTH, len(here) * event_ns)
        column = (column + 1) % WIDTH
    return sent, lost


_CROSSING = st.tuples(st.integers(0, END_NS - 1), st.integers(0, WIDTH * HEIGHT - 1), st.booleans())


@given(
    st.lists(_CROSSING, max_size=200),
    st.lists(st.integers(0, END_NS), max_size=5),
    st.sampled_from([2.0, 500.0]),
    st.sampled_from([None, 0, 20_000]),
)
def test_it_does_what_the_rules_say_however_time_is_divided(drawn, cuts, event_ns, busy_ns):
    found = crossings(*([*zip(*drawn, strict=True)] or [[], [], []]))
    reset = ResetParameters(at_acknowledge=busy_ns is not None)
    readout = ScanReadOut(parameters(event_ns, reset=reset, refractory_us=(busy_ns or 0) / 1000))
    parts, k = [], 0
    for end in [*sorted(cuts), END_NS]:
        n = int(np.searchsorted(found.t_ns, end))
        parts.append(readout.push(Crossings(found.t_ns[k:n], found.pixel[k:n], found.on[k:n]), end))
        k = n
        assert readout.raised == readout.read_out + readout.lost_at_readout + readout.pending
    events = np.concatenate([*parts, readout.finish()])
    sent, lost = slow(found, event_ns, busy_ns)
    assert events.tolist() == sent
    assert readout.lost_at_readout == lost
    assert readout.pending == 0


def test_intervals_are_whole_scans_and_columns_are_swept():
    p = dataclasses.replace(PRESETS["dvxplorer_micro"], width=64, height=48, refractory_us=0.0)
    sensor = Sensor(p, 1)
    x = np.arange(64) / 64
    pictures = [
        np.exp(np.tile(1.5 * np.sin(2 * np.pi * (x + 12e-9 * t)), (48, 1))) for t in range(0, 200_000_001, 10**6)
    ]
    sensor.reset(LightFrame(0, pictures[0].astype(np.float32)))
    times = range(10**6, 200_000_001, 10**6)
    events = np.concatenate(
        [sensor.expose(LightFrame(t, q.astype(np.float32))) for q, t in zip(pictures[1:], times, strict=True)]
    )
    pixel = events["y"].astype(int) * 64 + events["x"]
    order = np.lexsort([events["t"], pixel])
    gaps = np.diff(events["t"][order].astype(float))[np.diff(pixel[order]) == 0] / 197.28
    assert gaps.size > 2000
    assert np.mean(abs(gaps - np.round(gaps)) < 0.02 * np.maximum(gaps, 1)) > 0.99
    assert np.round(gaps).min() >= 1
    inside = events[events["x"] > 0]  # the first column's stamps, cut to whole us, may lie before the scan
    assert np.corrcoef(inside["t"] % 197.28, inside["x"])[0, 1] > 0.999


def test_scans_get_slower_under_load():
    readout = ScanReadOut(parameters(event_ns=1000.0))  # six events of a column take six times its time
    every = np.tile(np.arange(WIDTH * HEIGHT), 3)
    at = np.repeat([0, 40_000, 80_000], WIDTH * HEIGHT)
    events = np.concatenate([readout.push(crossings(at, every, every >= 0), 10**6), readout.finish()])
    first = events["t"][(events["x"] == 0) & (events["y"] == 0)]
    assert first[0] == 0
    assert first[1] == WIDTH * HEIGHT  # us: a whole scan of them, not 16
    assert readout.lost_at_readout == pytest.approx(WIDTH * HEIGHT, abs=HEIGHT * WIDTH)


def test_after_thirty_days_the_looks_are_where_they_were():
    p, day = parameters(width=7), 30 * 86_400 * 10**9
    one = Crossings(np.array([day + 5]), np.array([3], np.uint32), np.array([True]))
    event = ScanReadOut(p).push(one, day + 10**6)
    column_ps = round(SCAN_NS * 1000 / 7)
    looks = -(-((day + 5) * 1000 - 3 * column_ps) // (7 * column_ps)) * 7 + 3
    assert event["t"].tolist() == [looks * column_ps // 1000 // 1000]


def test_a_pixel_is_busy_from_the_read_of_its_column_on():
    """Column 0 is read every 16 us: the first event leaves at 16 us, and the pixel is busy until 36 us."""
    found = crossings([1, 20_000, 35_999, 36_000], [0, 0, 0, 0], [True] * 4)
    readout = ScanReadOut(parameters(reset=ResetParameters(at_acknowledge=True), refractory_us=20.0))
    assert np.concatenate([readout.push(found, END_NS), readout.finish()])["t"].tolist() == [16, 48]
    assert (readout._queue.busy, readout.lost_at_readout, readout.read_out) == (2, 2, 2)


def test_the_time_of_a_scan_can_change_between_two_steps():
    sensor = Sensor(parameters(), 0)
    assert sensor.adjustable["scan_us"] == SCAN_NS / 1000
    readout = ScanReadOut(parameters())
    again = np.arange(0, 50 * SCAN_NS, 1000)
    pixel = np.full(len(again), 5)
    first = readout.push(crossings(again, pixel, pixel > 0), 50 * SCAN_NS)
    readout.set_scan_us(3 * SCAN_NS / 1000)
    later = readout.push(crossings(again + 50 * SCAN_NS, pixel, pixel > 0), 100 * SCAN_NS)
    assert set(np.diff(first["t"]).tolist()) == {SCAN_NS // 1000}
    assert set(np.diff(later["t"]).tolist()) == {3 * SCAN_NS // 1000}
    with pytest.raises(ValueError, match="above 0"):
        sensor.adjust("scan_us", 0.0)


def test_an_arbiter_has_no_time_of_a_scan():
    sensor = Sensor(dataclasses.replace(PRESETS["davis346"], width=8, height=8), 0)
    assert "scan_us" not in sensor.adjustable
    with pytest.raises(ValueError, match="cannot be changed"):
        sensor.adjust("scan_us", 100.0)
