"""Words of event sensors as plain bytes: EVT2, EVT2.1 and EVT3 of Prophesee, and AER words as SPIF boards use them.

    evt3     u16   see `firmware_protocol.evt.words`
    evt2     u32   see `firmware_protocol.evt.evt2`
    evt21    u64   the same, as the GenX320 sends it
    spif     u32   bit 31 = 1 no time, 30..16 x, 15 ON, 14..0 y

All are little-endian and without a header, like the data of a `.raw` file after its header. An edge is an EXT_TRIGGER
word of the EVT formats. A receiver needs a time (evt3: and a row) before it can use an event:

    connection     each packet begins with them, and silences have a high part when it changes
    datagram       each begins with them
    serial line    they are repeated in periods, as sensors repeat the high part: every 16 us, or the next power of two
                   in which the high parts take at most an eighth of the line

The high part wraps, so a receiver that joins later has the time modulo 2^24 us (evt3) or 2^34 us. The formats cannot
report a restart of the clock: the time goes back.

Sources: docs.prophesee.ai, "EVT 3.0 Format", "EVT 2.0 Format", "EVT 2.1 Format"; aestream, `dvs_to_udp.cpp`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from math import ceil, log2
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import Edges, Events
from firmware_protocol.network_streams.coders import ConnectionCoder, Datagram, DatagramCoder, StreamFacts, cut

if TYPE_CHECKING:
    from firmware_protocol.evt.evt2 import Form
    from firmware_protocol.evt.words import Coder

_DATAGRAM_OCTETS = 1472  # no network of 1500 bytes splits it
_HIGH_OCTETS = {"evt2": 4, "evt21": 8, "evt3": 2}
_LEAST_REPEAT_US = 16
_SHARE = 8
_LONGEST_SILENCE_US = 3_600_000_000  # then another stream begins: 1000 high parts lead through this one


def repeat_us(form: str, bytes_per_s: float) -> int:
    """Return the period in which a line of this capacity repeats the high part, a power of two; 0 without times."""
    if form not in _HIGH_OCTETS:
        return 0
    least_us = _SHARE * _HIGH_OCTETS[form] * 1e6 / bytes_per_s
    return 1 << ceil(log2(max(_LEAST_REPEAT_US, least_us)))


class _Evt:
    """Coder of one stream: it begins at the time of its first item, and a late edge gets the present time."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 11, 1 << 11)
    has_edges: ClassVar[bool] = True

    def __init__(self, facts: StreamFacts) -> None:
        from firmware_protocol.evt.evt2 import Evt2Encoder
        from firmware_protocol.evt.evt3 import Evt3Encoder

        self.facts = facts
        repeat = facts.repeat_us
        self._coder: Coder
        if facts.form == "evt3":
            self._coder = Evt3Encoder(standalone=not repeat, width=facts.size[0], repeat_us=repeat)
        else:
            form: Form = "evt21" if facts.form == "evt21" else "evt2"
            self._coder = Evt2Encoder(form, standalone=not repeat, repeat_us=repeat)
        self._is_new = True  # another stream begins with the next item

    def _reach(self, t_us: int) -> None:
        """Begin the stream at `t_us` if it has not begun, or after a long silence."""
        if self._is_new or t_us - self._coder.last_us > _LONGEST_SILENCE_US:
            self._coder.begin(t_us)
            self._is_new = False

    def _prepare(self, events: Events, edges: Edges) -> Edges:
        """Return the edges (m,) with times that can follow; the next words are those of these items."""
        if len(events) or len(edges):
            self._reach(min(int(records["t"][0]) for records in (events, edges) if len(records)))
        if not len(edges) or int(edges["t"][0]) >= self._coder.last_us:
            return edges
        later = edges.copy()
        later["t"] = np.maximum(edges["t"], np.uint64(self._coder.last_us))
        return later


class EvtConnectionCoder(_Evt, ConnectionCoder):
    """Coder of words for a connection, or for a serial line if `facts.repeat_us` is the period of its repetitions."""

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return words; an edge precedes the events of its time."""
        return self._coder.encode(events, self._prepare(events, edges))

    def advance(self, t_us: int) -> bytes:
        """Return the high parts that are due."""
        self._reach(t_us)
        return self._coder.advance(t_us)

    def restart(self) -> bytes:
        """Begin another stream."""
        self._is_new = True
        return b""


class EvtDatagramCoder(_Evt, DatagramCoder):
    """Coder of words for datagrams, each of which can be read without the others."""

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; an edge precedes the events of its time."""
        edges = self._prepare(events, edges)
        for part in self._coder.parts(events, edges, _DATAGRAM_OCTETS):
            yield Datagram(part.words, part.events)

    def restart(self) -> Iterator[Datagram]:
        """Begin another stream."""
        self._is_new = True
        yield from ()


_NO_TIME = np.uint32(1 << 31)
_SPIF_EVENTS = 128  # AEStream's receiver reads 512 bytes of a datagram
_SPIF_LIMIT_PX = (1 << 15, 1 << 15)


def _spif_words(events: Events) -> npt.NDArray[np.uint32]:
    """Return a word for each of events (n,), without its time."""
    words: npt.NDArray[np.uint32] = events["x"].astype("<u4")
    words <<= 16
    words |= events["on"].astype("<u4") << 15
    words |= events["y"]
    words |= _NO_TIME
    return words


class SpifConnectionCoder(ConnectionCoder):
    """Coder of AER words for a connection or a serial line: an event has its time of arrival."""

    limit_px: ClassVar[tuple[int, int]] = _SPIF_LIMIT_PX

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return the words of the events; edges are left out."""
        return _spif_words(events).tobytes()


class SpifCoder(DatagramCoder):
    """Coder of AER words for AEStream, spiffer and SPIF boards: an event has its time of arrival."""

    limit_px: ClassVar[tuple[int, int]] = _SPIF_LIMIT_PX

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams of the events; edges are left out."""
        yield from cut(_spif_words(events), _SPIF_EVENTS)


WORD_CONNECTION_CODERS: Mapping[str, type[ConnectionCoder]] = {
    **dict.fromkeys(_HIGH_OCTETS, EvtConnectionCoder),
    "spif": SpifConnectionCoder,
}
"""Coders for connections and serial lines, by the name of the format in rigs."""

WORD_DATAGRAM_CODERS: Mapping[str, type[DatagramCoder]] = {
    **dict.fromkeys(_HIGH_OCTETS, EvtDatagramCoder),
    "spif": SpifCoder,
}
"""Coders for datagrams, by the name of the format in rigs."""
