"""EVT3 words to events and edges, also those of real sensors."""

from __future__ import annotations

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.evt3.reading import HIGH_READ, count_words, new_state, read_words
from firmware_protocol.evt3.words import HIGH

__all__ = ["Evt3Decoder"]


class Evt3Decoder:
    """Reads words piece by piece. What comes before the first time is left out, as its time is unknown."""

    def __init__(self) -> None:
        self._state = new_state()
        self._rest = b""
        self.decode(b"")  # compiles the kernels now, not when words wait

    def decode(self, data: bytes) -> tuple[Events, Edges]:
        """Return events (n,) EVENT and edges (m,) EDGE of the next bytes, which may end inside a word.

        Any bytes are words: there is no error, and at most 12 events a word.
        """
        data = self._rest + data
        whole = len(data) & ~1
        self._rest = data[whole:]
        words = np.frombuffer(data[:whole], "<u2")
        if self._state[HIGH_READ] < 0:
            starts = np.flatnonzero(words >> 12 == HIGH)
            words = words[starts[0] :] if len(starts) else words[:0]
        n_events, n_edges = count_words(words)
        events, edges = empty_events(n_events), empty_edges(n_edges)
        read_words(words, self._state, events.view(np.uint8), edges.view(np.uint8))
        return events, edges
