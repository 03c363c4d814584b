"""What waits for a viewer is bounded, whatever the viewer does."""

import numpy as np
import pytest

from emulator.live_page.messages import BadMessage
from emulator.live_page.process import Canvas
from emulator.live_page.server import STALLED_S, Viewer, Viewers
from firmware_protocol.events import EVENT
from tests.made_events import events_at


class _Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


_NO_EVENTS = np.zeros(0, EVENT)
_PICTURE = Canvas((4, 3)).draw(_NO_EVENTS, np.zeros((3, 4), np.float32), 1)


def _taken(viewer):
    """Return all that can be sent now."""
    return list(iter(viewer.take, None))


def test_a_viewer_that_missed_pictures_gets_their_events_at_their_times():
    """Events of the stretch from 10 to 40 ms, in pictures of unequal length, some of them without an event."""
    rng, viewer, canvas = np.random.default_rng(1), Viewer(1, _Clock()), Canvas((40, 30))
    canvas.draw(_NO_EVENTS, np.zeros((30, 40), np.float32), 10_000)
    events = events_at(
        np.sort(rng.integers(10_000, 30_000, 900)),
        x=rng.integers(0, 40, 900),
        y=rng.integers(0, 30, 900),
        on=rng.random(900) < 0.5,
    )
    light = np.zeros((30, 40), np.float32)
    for _ in range(3):
        viewer.put(_PICTURE)
        _taken(viewer)
    first = 0
    for until_us in (10_000, 12_000, 25_000, 25_000, 30_000, 40_000):
        count = int(np.searchsorted(events["t"], until_us, "right")) - first
        viewer.put(canvas.draw(events[first : first + count], light, until_us))
        first += count
    viewer.has_seen(1)
    (picture,) = _taken(viewer)
    expected = {}
    for t, x, y, on in events.tolist():
        _, _, ups, downs = expected.get(40 * y + x, (0, False, 0, 0))
        expected[40 * y + x] = (t, on, ups + on, downs + (not on))
    assert (picture.from_us, picture.until_us, picture.events) == (10_000, 40_000, 900)
    assert picture.place.tolist() == sorted(expected)
    times_us = 10_000 + 30_000 * np.abs(picture.last.astype(int)) / 127
    for k, (t, on, ups, downs) in enumerate(expected[place] for place in sorted(expected)):
        assert abs(times_us[k] - t) < 700  # 2 of 127 parts, and rounding
        assert (picture.last[k] > 0, picture.count[k] & 15, picture.count[k] >> 4) == (on, min(ups, 15), min(downs, 15))
    assert picture.place.dtype == np.uint32


def test_answers_that_nobody_takes_are_bounded():
    viewer = Viewer(1, _Clock())
    for k in range(1000):
        viewer.answer(str(k))
    sent = _taken(viewer)
    for k in range(1, 100):
        try:
            viewer.has_seen(k)
        except BadMessage:
            break
        sent += _taken(viewer)
    assert len(sent) == 16
    assert sent[-1] == "999"


@pytest.mark.parametrize("number", [-1, 2, 10**9])
def test_what_was_not_sent_cannot_be_seen(number):
    viewer = Viewer(1, _Clock())
    viewer.put(_PICTURE)
    _taken(viewer)
    with pytest.raises(BadMessage):
        viewer.has_seen(number)


def test_messages_are_bounded_in_number_and_time_gives_new_ones():
    clock = _Clock()
    viewer = Viewer(1, clock)
    for _ in range(200):
        viewer.charge()
    with pytest.raises(BadMessage, match="too many"):
        viewer.charge()
    clock.now_s = 1.0
    for _ in range(90):
        viewer.charge()


def test_who_shows_nothing_for_long_is_dropped_and_who_has_nothing_to_show_is_not():
    clock, dropped = _Clock(), []
    viewers = Viewers(clock)
    reading, stalled, idle = (viewers.enter(lambda k=k: dropped.append(k)) for k in range(3))
    for viewer in (reading, stalled):
        for _ in range(3):
            viewer.put(_PICTURE)
            _taken(viewer)
    clock.now_s = STALLED_S - 1
    reading.has_seen(2)
    clock.now_s = STALLED_S + 1
    viewers.drop_stalled()
    assert dropped == [1]
    assert len(viewers) == 2
    assert idle.on_the_way == 0
