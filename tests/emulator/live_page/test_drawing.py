"""Pictures for the page, beside counts made one event at a time."""

import numpy as np
import pytest

from emulator.live_page.process import Canvas, SharedView, reduction
from firmware_protocol.events import EVENT
from tests.emulator.live_page.pictures import light_of_codes
from tests.made_events import events_at


def _events(rows):
    return np.array([tuple(row) for row in rows], EVENT)


def test_planes_hold_the_last_event_and_the_counts_of_each_pixel():
    canvas = Canvas((4, 3))
    events = _events([(1, 0, 0, True), (500, 3, 2, False), (600, 0, 0, True), (1000, 0, 0, False)])
    picture = canvas.draw(events, np.zeros((3, 4), np.float32), 1000)
    assert list(picture.place) == [0, 2 * 4 + 3]
    assert list(picture.last) == [-127, -64]
    assert list(picture.count) == [2 + (1 << 4), 1 << 4]
    assert (picture.from_us, picture.until_us, picture.events, picture.every) == (0, 1000, 4, 1)
    assert canvas.draw(events[:0], np.zeros((3, 4), np.float32), 2000).from_us == 1000


@pytest.mark.parametrize("size", [(346, 260), (1280, 720), (33, 17), (2048, 64)])
def test_counts_are_those_of_a_loop(size):
    rng, n = np.random.default_rng(1), 3000
    events = events_at(
        np.sort(rng.integers(0, 40_000, n)),
        x=rng.integers(0, size[0], n),
        y=rng.integers(0, size[1], n),
        on=rng.random(n) < 0.5,
    )
    canvas, by = Canvas(size), reduction(size)
    expected, last = np.zeros((2, *canvas.shape), int), np.zeros(canvas.shape, int)
    for _, x, y, on in events:
        expected[int(on), y // by, x // by] += 1
        last[y // by, x // by] = 1 if on else -1
    picture = canvas.draw(events, np.zeros(canvas.shape, np.float32), 40_000)
    assert np.array_equal(picture.place, np.flatnonzero(last))
    assert np.array_equal(picture.count & 15, np.minimum(expected[1], 15)[last != 0])
    assert np.array_equal(picture.count >> 4, np.minimum(expected[0], 15)[last != 0])
    assert np.array_equal(np.sign(picture.last), last[last != 0])
    assert canvas.shape[1] <= 640
    assert canvas.shape[0] <= 480


def test_very_many_events_are_thinned_out_and_that_is_told():
    events = np.zeros(200_000, EVENT)
    picture = Canvas((4, 3)).draw(events, np.zeros((3, 4), np.float32), 40_000)
    assert picture.events == 200_000
    assert picture.every == 4


def test_light_is_sent_with_its_value():
    light = np.geomspace(1e-6, 1e6, 20, dtype=np.float32).reshape(4, 5)
    sent = Canvas((5, 4)).draw(np.zeros(0, EVENT), light, 1).light
    assert np.allclose(light_of_codes(sent), light, rtol=2**-9)


def _every(count, until_us):
    """Return `count` events, the last at `until_us`."""
    return events_at(until_us - count + 1 + np.arange(count))


def test_the_shown_time_is_that_of_the_events_when_they_are_not_taken():
    """A step without room is left out whole; time and events of the ones before stay together."""
    view, light = SharedView((4, 3)), np.zeros((3, 4), np.float32)
    view.viewers.value = 1
    for step in range(1, 5):
        view.show(_every(200_000, 200_000 * step), light, 200_000 * step)
    events, until_us = view.take()
    assert (int(events["t"][-1]), until_us) == (400_000, 400_000)
    view.show(_every(200_000, 1_000_000), light, 1_000_000)
    assert view.take()[1] == 1_000_000


def test_events_are_taken_with_their_time():
    view = SharedView((4, 3))
    view._ring.push(_every(10, 1000))  # the step is being shown: its time is not published yet
    assert len(view.take()[0]) == 0
    view._ring.publish(1000)
    assert [len(view.take()[0]), view.take()[1]] == [10, 1000]
