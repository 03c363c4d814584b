"""Pictures for the page, beside counts made one event at a time."""

import numpy as np
import pytest

from emulator.live_page.process import Canvas, reduction
from firmware_protocol.events import EVENT


def _events(rows):
    return np.array([tuple(row) for row in rows], EVENT)


def test_planes_hold_the_last_event_and_the_counts_of_each_pixel():
    canvas = Canvas((4, 3))
    events = _events([(1, 0, 0, True), (500, 3, 2, False), (600, 0, 0, True), (1000, 0, 0, False)])
    picture = canvas.draw(events, np.zeros((3, 4), np.float32), 1000)
    assert picture.last[0, 0] == -127
    assert picture.last[2, 3] == -64
    assert np.count_nonzero(picture.last) == 2
    assert picture.count[0, 0] == 2 + (1 << 4)
    assert picture.count[2, 3] == 1 << 4
    assert (picture.from_us, picture.until_us, picture.events, picture.every) == (0, 1000, 4, 1)
    assert canvas.draw(events[:0], np.zeros((3, 4), np.float32), 2000).from_us == 1000


@pytest.mark.parametrize("size", [(346, 260), (1280, 720), (33, 17), (2048, 64)])
def test_counts_are_those_of_a_loop(size):
    rng, n = np.random.default_rng(1), 3000
    events = np.zeros(n, EVENT)
    events["t"] = np.sort(rng.integers(0, 40_000, n))
    events["x"], events["y"], events["on"] = (
        rng.integers(0, size[0], n),
        rng.integers(0, size[1], n),
        rng.random(n) < 0.5,
    )
    canvas, by = Canvas(size), reduction(size)
    expected, last = np.zeros((2, *canvas.shape), int), np.zeros(canvas.shape, int)
    for _, x, y, on in events:
        expected[int(on), y // by, x // by] += 1
        last[y // by, x // by] = 1 if on else -1
    picture = canvas.draw(events, np.zeros(canvas.shape, np.float32), 40_000)
    assert np.array_equal(picture.count & 15, np.minimum(expected[1], 15))
    assert np.array_equal(picture.count >> 4, np.minimum(expected[0], 15))
    assert np.array_equal(np.sign(picture.last), last)
    assert canvas.shape[1] <= 640
    assert canvas.shape[0] <= 480


def test_very_many_events_are_thinned_out_and_that_is_told():
    events = np.zeros(200_000, EVENT)
    picture = Canvas((4, 3)).draw(events, np.zeros((3, 4), np.float32), 40_000)
    assert picture.events == 200_000
    assert picture.every == 4


def test_light_is_a_square_root_and_what_is_not_finite_is_harmless():
    light = np.tile(np.linspace(0, 1, 64, dtype=np.float32), (64, 1))
    light[0, 1:4] = np.nan, np.inf, -np.inf
    picture = Canvas((64, 64)).draw(np.zeros(0, EVENT), light, 1)
    white = np.quantile(light[::4, ::4][light[::4, ::4] > 0], 0.99)
    expected = 255 * np.sqrt(np.clip(light[1:] / white, 0, 1))
    assert np.abs(picture.light[1:] - expected).max() <= 1
    assert list(picture.light[0, 1:4]) == [0, 255, 0]


def test_dark_light_is_black():
    assert not Canvas((5, 5)).draw(np.zeros(0, EVENT), np.full((5, 5), np.nan, np.float32), 1).light.any()
