"""Events of EVT2 and EVT2.1 words, compiled: one pass counts them, the next writes the records."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.evt3 import evt2_words
from firmware_protocol.evt3.compiled import entry, kernel
from firmware_protocol.evt3.evt2_writing import MASK_FIRST, NO_MASK
from firmware_protocol.evt3.reading import full_high, put_edge, put_event

__all__ = ["count_evt2", "read_evt2"]

_Bytes = npt.NDArray[np.uint8]
_Words = npt.NDArray[np.uint32]
_State = npt.NDArray[np.int64]

_ON, _HIGH, _TRIGGER = evt2_words.ON, evt2_words.HIGH, evt2_words.TRIGGER
_HIGH_BITS = evt2_words.HIGH_BITS


@kernel
def _pair(words: _Words, i: int, mask: int) -> tuple[int, int]:
    """Return word `i` and its columns; those of a word without a mask are its own one."""
    if mask == NO_MASK:
        return int(np.int64(words[i])), 1
    first, second = int(np.int64(words[2 * i])), int(np.int64(words[2 * i + 1]))
    return (second, first) if mask == MASK_FIRST else (first, second)


@entry
def count_evt2(words: _Words, mask: int, is_started: bool) -> tuple[int, int]:
    """Return how many events and edges (n,) words hold, from the first high part on unless `is_started`."""
    events, edges = 0, 0
    for i in range(len(words) if mask == NO_MASK else len(words) // 2):
        word, columns = _pair(words, i, mask)
        kind = word >> 28
        is_started = is_started or kind == _HIGH
        if is_started and kind <= _ON:
            while columns:
                columns &= columns - 1
                events += 1
        edges += is_started and kind == _TRIGGER
    return events, edges


@entry
def read_evt2(words: _Words, mask: int, state: _State, events: _Bytes, edges: _Bytes) -> None:
    """Write the records of all (n,) words; `state` is (1,), the full high part, -1 before the first."""
    at, at_edge = 0, 0
    for i in range(len(words) if mask == NO_MASK else len(words) // 2):
        word, columns = _pair(words, i, mask)
        kind, t = word >> 28, state[0] << 6 | (word >> 22 & 0x3F)
        if kind == _HIGH:
            state[0] = full_high(state[0], word & 0xFFFFFFF, _HIGH_BITS)
        elif state[0] < 0:
            continue
        elif kind <= _ON:
            x = word >> 11 & 0x7FF
            while columns:
                if columns & 1:
                    at = put_event(events, at, t, x, word & 0x7FF, kind)
                columns >>= 1
                x += 1
        elif kind == _TRIGGER:
            at_edge = put_edge(edges, at_edge, t, word >> 8 & 0x1F, word & 1)
