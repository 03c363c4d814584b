"""The facilities of the GenX320 that select events: windows, latches, masks, crop, rate, noise and flicker filters."""

import numpy as np
import pytest
from evt2_words import by_the_tables
from genx320_host import events_of, octets, running
from hypothesis import given, settings
from hypothesis import strategies as st

from firmware_protocol.events import EVENT
from tests.made_events import events_at

LAST = 320 << 16


def grid():
    """One event of each pixel, at one time."""
    events = np.zeros(320 * 320, EVENT)
    events["t"], events["on"] = 10, True
    events["x"], events["y"] = np.tile(np.arange(320), 320), np.repeat(np.arange(320), 320)
    return events


def seen_by(camera, events):
    camera.offer(events)
    camera.advance(int(events["t"][-1]) + 1)
    assert camera.counters.balanced
    return by_the_tables(octets(camera), "evt21")[0]


def places(seen):
    shown = np.zeros((320, 320), bool)
    shown[seen["y"], seen["x"]] = True
    return shown


def window(i, columns, rows):
    return ((0x400 + 8 * i, columns[1] << 16 | columns[0]), (0x404 + 8 * i, rows[1] << 16 | rows[0]))


def master(count, mode=0):
    return (0x0034, 3 | mode << 2 | count << 3)


@pytest.mark.parametrize("mode", [0, 1])
def test_windows_pass_their_union_or_what_is_outside(mode):
    camera, _ = running(*window(0, (10, 20), (30, 50)), *window(17, (0, 0), (0, 0)), *window(1, (15, 320), (40, 45)),
                        master(2, mode), fifo_bytes=1 << 20)  # fmt: skip
    expected = np.zeros((320, 320), bool)
    expected[30:50, 10:20] = expected[40:45, 15:320] = True
    assert np.array_equal(places(seen_by(camera, grid())), expected != bool(mode))
    assert camera.counters.not_selected == np.count_nonzero(expected == bool(mode))


def test_windows_wait_for_the_run_bit_and_the_array_control_switches_them():
    camera, host = running(*window(0, (10, 20), (30, 50)), (0x0034, 1 | 1 << 3), fifo_bytes=1 << 20)
    assert places(seen_by(camera, grid())).all()
    host.write(master(1))
    host.write((0x0000, 0xC00))
    later = grid()
    later["t"] = 100
    camera.offer(later)
    assert camera.counters.not_selected == 0
    host.write((0x0000, 0xC02))
    later["t"] = 200
    camera.offer(later)
    assert camera.counters.not_selected == 320 * 320 - 10 * 20


def test_latches_take_over_the_rows_that_are_selected():
    rows = [0, 37, 319]
    entries = [(0x2000 + 4 * i, 0) for i in range(10)] + [(0x2004, 1 << 5), (0x2024, 1 << 31)]  # columns 37 and 319
    entries += [(0x3000 + 4 * i, 0) for i in range(10)] + [(0x3000 + 4 * (row // 32), 1 << row % 32) for row in rows]
    camera, host = running(*entries, fifo_bytes=1 << 20)
    assert places(seen_by(camera, grid())).all()
    host.write((0x0000, 0xC22), (0x0000, 0xC02))
    expected = np.ones((320, 320), bool)
    expected[np.ix_(rows, [37, 319])] = False
    later = grid()
    later["t"] = 100
    assert np.array_equal(places(seen_by(camera, later)), expected)


def test_masks_hide_pixels_of_a_group_while_they_are_on():
    camera, host = running((0x9100, 1 << 31 | 100 << 4 | 2), (0x9104, 0b1001), (0x9178, 1 << 31 | 319 << 4 | 9),
                           (0x917C, 1 << 31), fifo_bytes=1 << 20)  # fmt: skip
    assert np.argwhere(~places(seen_by(camera, grid()))).tolist() == [[100, 64], [100, 67], [319, 319]]
    host.write((0x9100, 100 << 4 | 2), (0x9178, 1 << 31 | 400 << 4 | 15))  # off; a row and a group that are none
    later = grid()
    later["t"] = 100
    assert places(seen_by(camera, later)).all()


def test_the_crop_drops_and_may_move_the_origin():
    bounds = ((0x9010, 20 << 16 | 10), (0x9014, 29 << 16 | 14))
    camera, host = running(*bounds, (0x900C, 1 | 1 << 2), fifo_bytes=1 << 20)
    expected = np.zeros((320, 320), bool)
    expected[20:30, 10:15] = True
    assert np.array_equal(places(seen_by(camera, grid())), expected)
    host.write((0x900C, 1 | 1 << 2 | 1 << 4))
    later = grid()
    later["t"] = 100
    assert np.array_equal(places(seen_by(camera, later)), np.roll(expected, (-20, -10), (0, 1)))
    assert later["x"].max() == 319  # those offered are as they were
    host.write((0x900C, 1))
    later["t"] = 200
    assert places(seen_by(camera, later)).all()


def test_the_rate_control_passes_so_many_in_a_period():
    entries = ((0x602C, 3), (0x6020, 100), (0x6014, 4), (0x6000, 1))
    events = events_of(*((t, 1, 1, True) for t in range(0, 1000, 10)))
    camera, host = running(*entries)
    assert seen_by(camera, events)["t"].tolist() == [t + k for t in range(0, 1000, 100) for k in (0, 10, 20)]
    assert camera.counters.dropped_rate == 70
    host.write((0x6000, 5))  # bypass
    events["t"] += 1000
    assert len(seen_by(camera, events)) == 100


def noise_filter(low, high):
    return ((0xE008, 100), (0xE00C, low[0]), (0xE010, low[1]), (0xE018, high[0]), (0xE014, high[1]), (0xE000, 1))


def counted(*counts):
    """`counts[k]` events in the period k of 100 us."""
    return events_of(*((100 * k + i, 1, 1, True) for k, count in enumerate(counts) for i in range(count)))


@pytest.mark.parametrize(
    ("counts", "passing"),
    [
        ((5, 5, 5), (5, 5, 5)),
        ((5, 1, 5, 8, 5), (5, 1, 0, 0, 5)),  # below 3 it drops; on until there are more than 6
        ((5, 25, 15, 5, 15), (5, 25, 0, 0, 15)),  # above 20 it drops; until there are less than 10
        ((5, 0, 0, 5, 8, 5), (5, 0, 0, 0, 0, 5)),  # silence is too low
    ],
)
def test_the_noise_filter_passes_rates_within_its_bounds(counts, passing):
    camera, _ = running(*noise_filter((3, 6), (20, 10)))
    seen = seen_by(camera, counted(*counts))
    assert np.bincount(seen["t"] // 100, minlength=len(counts)).tolist() == list(passing)


def flicker(period_us, count, start_us=0, x=5):
    half = period_us // 2
    return events_of(*((start_us + half * k, x, 7, k % 2 == 0) for k in range(2 * count)))


FLICKER = ((0x00B8, 1), (0xC008, 6 << 3 | 4), (0xC00C, 60 << 8 | 20), (0xC000, 1))  # 2.56 to 7.8 ms


@pytest.mark.parametrize(("period_us", "passing"), [(5000, 14), (1000, 40), (20_000, 40)])
def test_the_flicker_filter_drops_pixels_that_flicker_in_its_band(period_us, passing):
    camera, _ = running(*FLICKER)
    # The first ON event is not after an OFF event; six periods have passed at the eighth.
    assert len(seen_by(camera, flicker(period_us, 20))) == passing


def test_the_flicker_filter_lets_a_pixel_go_and_can_be_inverted():
    camera, host = running(*FLICKER)
    seen_by(camera, flicker(5000, 10))
    assert len(seen_by(camera, flicker(20_000, 10, 100_000))) == 16  # two rises until its count is 4
    camera, host = running(*FLICKER, (0xC008, 1 << 6 | 6 << 3 | 4))
    assert len(seen_by(camera, flicker(5000, 20))) == 26
    host.write((0xC000, 5))
    assert len(seen_by(camera, flicker(5000, 20, 200_000))) == 40


@settings(deadline=None, max_examples=25)
@given(st.integers(0, 1 << 32), st.lists(st.integers(1, 400), max_size=6), st.booleans())
def test_the_selection_does_not_depend_on_the_batches(seed, cuts, inverted):
    rng = np.random.default_rng(seed)
    events = events_at(
        np.sort(rng.integers(0, 60_000, 500)),
        x=rng.integers(0, 3, 500),
        y=rng.integers(0, 2, 500),
        on=rng.random(500) < 0.5,
    )
    entries = (*noise_filter((1, 2), (9, 6)), (0xE008, 800), (0x602C, 4), (0x6020, 500), (0x6014, 4), (0x6000, 1),
               *FLICKER[:1], (0xC008, inverted << 6 | 2 << 3 | 1), (0xC00C, 60 << 8 | 2), (0xC000, 1))  # fmt: skip
    (whole, _), (parts, _) = running(*entries), running(*entries)
    whole.offer(events)
    for part in np.split(events, sorted(set(cuts))):
        parts.offer(part)
    assert octets(parts) == octets(whole) != b""
    assert parts.counters == whole.counters
