"""A recording that is played in a loop, and what a reader of the camera must see of it, event by event.

The truth is arithmetic on the recording alone: event k of an endless loop over n events, whose last time is
(n - 1) * gap_us, is event k mod n, later by (k // n) * n * gap_us.
"""

import numpy as np

from firmware_protocol.events import EVENT, copy_events, join_events
from tests.npz_records import save_record

__all__ = ["Follower", "Looped"]

_ALIKE = 64
"""So many events name a place in the recording."""


class Looped:
    """`count` events at random times, `gap_us` apart on average, at random pixels of a sensor, of 346 x 260 by default.

    Attributes
    ----------
    events : (count,) EVENT, the first at time 0.
    round_us : length of a round.
    """

    def __init__(self, count, gap_us, size=(346, 260)):
        draw = np.random.default_rng(1)
        last_us = (count - 1) * gap_us
        self.round_us = count * gap_us
        self.events = np.zeros(count, EVENT)
        self.events["t"] = np.sort(draw.integers(0, last_us, count, endpoint=True))
        self.events["t"][0], self.events["t"][-1] = 0, last_us
        self.events["x"], self.events["y"] = draw.integers(0, size[0], count), draw.integers(0, size[1], count)
        self.events["on"] = draw.integers(0, 2, count)

    def save(self, path):
        """Write it as `--record` does."""
        save_record(path, self.events, [])

    def stretch(self, first, count):
        """Return `count` events of the endless loop from number `first` on, in time since its beginning."""
        pieces = []
        while count:
            round_number, place = divmod(first, len(self.events))
            piece = copy_events(self.events[place : place + count])
            piece["t"] += np.uint64(round_number * self.round_us)
            pieces.append(piece)
            first, count = first + len(piece), count - len(piece)
        return join_events(pieces)

    def place_of(self, seen):
        """Return the number, in the first round, of the event that `seen` (n,) begins with; n is at least 64."""
        head = seen[:_ALIKE]
        alike = (self.events["x"] == head["x"][0]) & (self.events["y"] == head["y"][0])
        found = [int(k) for k in np.flatnonzero(alike) if _same(self.stretch(int(k), len(head)), head)]
        assert len(found) == 1, f"the recording has {len(found)} places that go on like what was seen"
        return found[0]


class Follower:
    """Compares what a reader sees with the loop; raises AssertionError at the first event that differs.

    Attributes
    ----------
    seen : events compared.
    last_us : time of the last in the reader's time.
    """

    def __init__(self, looped):
        self._looped = looped
        self._held = np.zeros(0, EVENT)
        self._first = None
        self._offset_us = 0
        self.seen = self.last_us = 0

    def take(self, events):
        """Compare the next events, (n,) EVENT in the reader's time."""
        if self._first is None:
            self._held = events = np.concatenate([self._held, events])
            if len(events) < _ALIKE:
                return
            self._first = self._looped.place_of(events)
            self._offset_us = int(events["t"][0]) - int(self._looped.events["t"][self._first])
        if not len(events):
            return
        wanted = self._looped.stretch(self._first + self.seen, len(events))
        wanted["t"] += np.uint64(self._offset_us % (1 << 64))
        if wanted.tobytes() != events.tobytes():
            wrong = np.flatnonzero(wanted != events)
            told = f"the first is {events[wrong[0]]}, not {wanted[wrong[0]]}"
            raise AssertionError(f"{len(wrong)} of {len(events)} events differ after {self.seen}; {told}")
        self.seen += len(events)
        self.last_us = int(events["t"][-1])


def _same(some, others):
    """Tell whether events are alike in all but when the first came."""
    gaps = np.array_equal(np.diff(some["t"]), np.diff(others["t"]))
    return gaps and np.array_equal(some[["x", "y", "on"]], others[["x", "y", "on"]])
