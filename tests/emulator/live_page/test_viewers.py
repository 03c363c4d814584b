"""What waits for a viewer is bounded, whatever the viewer does."""

import pytest

from emulator.live_page.messages import BadMessage
from emulator.live_page.server import MOST_VIEWERS, STALLED_S, Viewer, Viewers


class _Clock:
    now_s = 0.0

    def __call__(self):
        return self.now_s


def _taken(viewer):
    """Return all that can be sent now."""
    return list(iter(viewer.take, None))


def test_three_messages_are_on_the_way_and_the_newest_picture_waits():
    viewer = Viewer(1, _Clock())
    taken = []
    for k in range(10):
        viewer.put(b"picture %d" % k)
        taken += _taken(viewer)
    assert taken == [b"picture 0", b"picture 1", b"picture 2"]
    viewer.has_seen(1)
    assert _taken(viewer) == [b"picture 9"]
    assert _taken(viewer) == []


def test_answers_go_before_a_status_and_a_status_before_a_picture():
    viewer = Viewer(1, _Clock())
    viewer.put(b"p")
    viewer.put("s")
    viewer.answer("a")
    assert _taken(viewer) == ["a", "s", b"p"]


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
    viewer.put(b"p")
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
            viewer.put(b"p")
            _taken(viewer)
    clock.now_s = STALLED_S - 1
    reading.has_seen(2)
    clock.now_s = STALLED_S + 1
    viewers.drop_stalled()
    assert dropped == [1]
    assert len(viewers) == 2
    assert idle.on_the_way == 0


def test_there_is_a_most_of_viewers():
    viewers = Viewers(_Clock())
    entered = [viewers.enter(lambda: None) for _ in range(MOST_VIEWERS)]
    assert None not in entered
    assert viewers.enter(lambda: None) is None
    viewers.leave(entered[0])
    assert viewers.enter(lambda: None) is not None
