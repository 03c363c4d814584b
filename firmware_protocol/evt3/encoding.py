"""Events and edges to EVT3 words.

Events of the same time, row and polarity whose columns rise within one window of 32 columns, which begins at a
multiple of 32, become four words (0x3, 0x4, 0x4, 0x5) where they are five or more. So no reader sees them in another
order than they were given in.
"""

from __future__ import annotations

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.evt3.coding import Coder, Filled, Words
from firmware_protocol.evt3.words import HIGH, HIGH_BITS, LIMIT_PX
from firmware_protocol.evt3.writing import write_words

__all__ = ["Evt3Encoder"]

_WORDS_AN_EVENT = 4  # high part, low part, row, column
_WORDS_AT_MOST_BESIDE = 4  # high part 0 of the start; both sides of a wrap and a step of the high part


class Evt3Encoder:
    """Makes words of events and edges; each call goes on where the last one ended.

    Parameters
    ----------
    standalone : whether the words of each call begin with their time and row, as messages and packets need it.
    width : of the sensor; no vector passes its last column. The default suits widths that are multiples of 32.
    origin_us : time of events and edges that is zero in the words; `advance` goes by the time of the words.
    """

    def __init__(self, *, standalone: bool = False, width: int = LIMIT_PX, origin_us: int = 0) -> None:
        words = Words(
            np.uint16, HIGH_BITS, HIGH_BITS,
            lambda events, edges, state, out: write_words(events, edges, width, state, out),
            lambda high: [HIGH << 12 | high & 0xFFF],
        )  # fmt: skip
        self._coder = Coder(words, standalone=standalone, origin_us=origin_us)

    @staticmethod
    def max_bytes(n_events: int) -> int:
        """Return how many bytes `encode` gives at most for `n_events` events and edges together.

        It holds while no time is more than 8.3 s after the newest one told before; `advance` through silences.
        """
        return 2 * (_WORDS_AN_EVENT * n_events + _WORDS_AT_MOST_BESIDE)

    def encode(self, events: Events, edges: Edges | None = None) -> bytes:
        """Return the words of events (n,) EVENT and edges (m,) EDGE, each sorted and no earlier than what was told.

        Edges come before events of the same time. Raises ValueError for a time that goes back, a gap of more than
        38 hours, or a place beyond 2047; the encoder then is as it was before.
        """
        return self._coder.encode(events, edges)

    def fill(self, events: Events, edges: Edges, octets: int) -> Filled:
        """Return the words of as many of the first events and edges as `octets` (64 to 65536) hold; as `encode`."""
        return self._coder.fill(events, edges, octets)

    def advance(self, t_us: int) -> bytes:
        """Return the words that bring readers to `t_us`, where nothing happens; no event may be earlier afterwards.

        Nothing where no high part is due (4096 us each), or where a later time was told already. Call it at least
        every 4 s of silence. Raises ValueError for a gap of more than 38 hours.
        """
        return self._coder.advance(t_us)
