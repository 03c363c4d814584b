"""The computer's side of a DAVIS346 on USB: bytes of bulk transfers in, events, edges and counts out. No USB.

    receiver = DavisReceiver()
    receiver.push(bulk_in(0x82))
    events = receiver.take_events()

A module of its own: the decoder loads numba, which a program with a `ClockEstimator` alone does not need.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict

from firmware_protocol.davis346.decoder import Decoder
from firmware_protocol.receiver.instrument import Receiver


class DavisReceiver(Receiver):
    """Decodes the word stream of endpoint 0x82; times are device time, which a timestamp reset sets to zero.

    Parameters
    ----------
    size
        (width, height) in user coordinates.
    turned
        True if the invert bit of the orientation register is set.
    """

    def __init__(self, size: tuple[int, int] = (346, 260), turned: bool = False) -> None:
        super().__init__()
        self._decoder = Decoder(size, turned)
        self._bytes = self._events = self._edges = self._resets = 0

    def push(self, data: bytes) -> None:
        """Process the next bytes of the stream, any number of them; never raises."""
        decoded = self._decoder.feed(data)
        edges = decoded.edges
        self._bytes += len(data)
        self._events += len(decoded.events)
        self._edges += len(edges)
        self._resets += len(decoded.resets)
        self._inbox.put_events(decoded.events)
        self._inbox.put_edges(edges)

    @property
    def counts(self) -> Mapping[str, int]:
        """All counts by name; only those that are not zero."""
        counts = {"bytes": self._bytes, "events": self._events, "edges": self._edges, "resets": self._resets}
        counts |= asdict(self._decoder.faults) | self._inbox.counts
        return {name: count for name, count in counts.items() if count}

    @property
    def faults(self) -> int:
        """Number of words that never occur in a correct stream."""
        return self._decoder.faults.total
