"""The course of an encoder, whatever its words: records to bytes, and silences."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import bytes_of
from firmware_protocol.events import Events, empty_events
from firmware_protocol.evt3.pending import (
    AT_EDGE,
    AT_EVENT,
    BACKWARDS,
    HIGH_TOLD,
    LAST,
    LONGEST_GAP_US,
    MUST_OPEN,
    OUTSIDE,
    ROW_TOLD,
    TIME_TOLD,
    TOO_LATE,
    new_state,
)
from firmware_protocol.evt3.words import LIMIT_PX, next_high

__all__ = ["Coder", "Filled", "Words"]

_ROOM_BYTES = 1 << 16
_COMPLAINTS = {
    BACKWARDS: "time goes back",
    TOO_LATE: "nothing for more than 38 hours",
    OUTSIDE: f"the words number {LIMIT_PX} columns and rows",
}

_Bytes = npt.NDArray[np.uint8]
_State = npt.NDArray[np.int64]


@dataclass(frozen=True)
class Words:
    """The words of a format.

    Attributes
    ----------
    dtype
        Of a word.
    low_bits, high_bits
        Of a time, in a low part and in a high part.
    write
        Writes the next words of events and edges, both as bytes; see `write_words`.
    high_words
        Gives the words of a high part.
    """

    dtype: type[np.unsignedinteger]
    low_bits: int
    high_bits: int
    write: Callable[[_Bytes, _Bytes, _State, npt.NDArray[np.unsignedinteger]], int]
    high_words: Callable[[int], list[int]]


class Filled(NamedTuple):
    """Words, and how many of the first events and edges they tell."""

    words: bytes
    events: int
    edges: int


class Coder:
    """Makes words; each call goes on where the last one ended, or with `standalone` begins with time and row.

    Its kernels are compiled, or read from the disk, when it is made: not when events wait.
    """

    def __init__(self, words: Words, *, standalone: bool, origin_us: int = 0) -> None:
        self._words = words
        self._standalone = standalone
        self._state = new_state(origin_us)
        self._out = np.empty(_ROOM_BYTES // np.dtype(words.dtype).itemsize, words.dtype)
        self.encode(empty_events())

    def encode(self, events: Events, edges: Edges | None = None) -> bytes:
        """Return the words of events (n,) EVENT and edges (m,) EDGE; see the encoders. Raises ValueError."""
        edges = empty_edges() if edges is None else edges
        state = self._begun()
        event_bytes, edge_bytes = bytes_of(events), bytes_of(edges)
        parts = []
        while True:
            parts.append(self._written(event_bytes, edge_bytes, state, self._out))
            if state[AT_EVENT] == len(events) and state[AT_EDGE] == len(edges):
                break
        if parts != [b""]:  # what has no words opens nothing
            self._state = state
        return b"".join(parts)

    def fill(self, events: Events, edges: Edges, octets: int) -> Filled:
        """Return the words of as many of the first events and edges as `octets` hold; see the encoders."""
        state = self._begun()
        room = self._out[: octets // self._out.itemsize]
        words = self._written(bytes_of(events), bytes_of(edges), state, room)
        if words:  # what has no words opens nothing
            self._state = state
        return Filled(words, int(state[AT_EVENT]), int(state[AT_EDGE]))

    def advance(self, t_us: int) -> bytes:
        """Return the words of a silence until `t_us`; see the encoders. Raises ValueError."""
        state, format_ = self._state, self._words
        if t_us - state[LAST] > LONGEST_GAP_US:
            raise ValueError(_COMPLAINTS[TOO_LATE])
        if t_us <= state[LAST]:
            return b""
        words, told, wanted = list[int](), int(state[HIGH_TOLD]), t_us >> format_.low_bits
        while told < wanted:
            told = next_high(told, wanted, format_.high_bits)
            words += format_.high_words(told)
        state[LAST] = t_us
        state[HIGH_TOLD] = told
        return np.array(words, format_.dtype).tobytes()

    def _begun(self) -> _State:
        """Return the state at the start of a call."""
        state = self._state.copy()
        state[AT_EVENT] = state[AT_EDGE] = 0
        if self._standalone:
            state[MUST_OPEN], state[TIME_TOLD], state[ROW_TOLD] = 1, -1, -1
        return state

    def _written(self, events: _Bytes, edges: _Bytes, state: _State, out: npt.NDArray[np.unsignedinteger]) -> bytes:
        size = self._words.write(events, edges, state, out)
        if size < 0:
            raise ValueError(_COMPLAINTS[size])
        return out[:size].tobytes()
