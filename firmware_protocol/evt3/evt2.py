"""Events and edges to EVT2 and EVT2.1 words, and back."""

from __future__ import annotations

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.events import Events, empty_events
from firmware_protocol.evt3.coding import Coder, Words
from firmware_protocol.evt3.evt2_reading import count_evt2, read_evt2
from firmware_protocol.evt3.evt2_words import HIGH, HIGH_BITS, LOW_BITS, Form
from firmware_protocol.evt3.evt2_writing import MASK_FIRST, MASK_LAST, NO_MASK, write_evt2

__all__ = ["Evt2Decoder", "Evt2Encoder"]

_MASKS = {"evt2": NO_MASK, "evt21": MASK_FIRST, "evt21-legacy": MASK_LAST}


class Evt2Encoder:
    """Makes words of events and edges; each call goes on where the last one ended.

    Parameters
    ----------
    form : EVT2, EVT2.1, or EVT2.1 as the IMX636 sends it. In EVT2.1, events of a time, row and polarity whose columns
        rise within 32 columns from a multiple of 32 share a word.
    standalone : whether the words of each call begin with their time.
    """

    def __init__(self, form: Form, *, standalone: bool = False) -> None:
        mask = _MASKS[form]
        beside = {NO_MASK: (), MASK_FIRST: (0,), MASK_LAST: (0,)}[mask]

        def high_words(high: int) -> list[int]:
            word = HIGH << 28 | high & 0xFFFFFFF
            return [*beside, word] if mask == MASK_FIRST else [word, *beside]

        words = Words(
            np.uint32, LOW_BITS, HIGH_BITS,
            lambda events, edges, state, out: write_evt2(events, edges, mask, state, out), high_words,
        )  # fmt: skip
        self._coder = Coder(words, standalone=standalone)

    def encode(self, events: Events, edges: Edges | None = None) -> bytes:
        """Return the words of events (n,) EVENT and edges (m,) EDGE, each sorted and no earlier than what was told.

        Edges come before events of the same time. Raises ValueError for a time that goes back, a gap of more than
        38 hours, or a place beyond 2047; the encoder then is as it was before.
        """
        return self._coder.encode(events, edges)

    def advance(self, t_us: int) -> bytes:
        """Return the words that bring readers to `t_us`, where nothing happens; no event may be earlier afterwards.

        Nothing where no high part is due (64 us each), or where a later time was told already. Raises ValueError for
        a gap of more than 38 hours.
        """
        return self._coder.advance(t_us)


class Evt2Decoder:
    """Reads words of a form piece by piece. What comes before the first time is left out, as its time is unknown."""

    def __init__(self, form: Form) -> None:
        self._mask = _MASKS[form]
        self._high = np.array([-1], np.int64)
        self._rest = b""
        self.decode(b"")  # compiles the kernels now, not when words wait

    def decode(self, data: bytes) -> tuple[Events, Edges]:
        """Return events (n,) EVENT and edges (m,) EDGE of the next bytes, which may end inside a word.

        Any bytes are words: there is no error, and at most an event for every two bits.
        """
        data = self._rest + data
        unit = 4 if self._mask == NO_MASK else 8
        whole = len(data) - len(data) % unit
        self._rest = data[whole:]
        words = np.frombuffer(data[:whole], "<u4")
        n_events, n_edges = count_evt2(words, self._mask, bool(self._high[0] >= 0))
        events, edges = empty_events(n_events), empty_edges(n_edges)
        read_evt2(words, self._mask, self._high, events.view(np.uint8), edges.view(np.uint8))
        return events, edges
