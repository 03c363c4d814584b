"""Which events and edges of a DAVIS346 reach a sound receiver when faults have changed its words.

Two decoders read, one what the camera sent and one what arrives. An event or edge survives when its own word arrives
and tells the same time, place and polarity. A receiver that misses a wrap therefore has no event of the camera's until
the next timestamp reset: all its times are wrong. A byte too many at the end of a transfer is thrown away, as libcaer
does.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.decoder import Decoded, Decoder
from firmware_protocol.davis346.words import MAX_ADDRESS, Special, Words, is_column
from firmware_protocol.usb.device import Transfer
from transports.faults.word_stages import SentWords

__all__ = ["Survivors"]

_ANY_SIZE = (MAX_ADDRESS + 1, MAX_ADDRESS + 1)  # faults change no address

_MARKS = [
    int(code)
    for code in (
        Special.INPUT_FALLING, Special.INPUT_RISING, Special.INPUT_PULSE, Special.GENERATOR_FALLING,
        Special.GENERATOR_RISING,
    )
]  # fmt: skip

Mask = npt.NDArray[np.bool_]


class Survivors:
    """Compares what was sent with what arrives, from the moment it is made."""

    def __init__(self) -> None:
        # What came before is the same for both, so both may begin at time zero and row zero.
        self._sent, self._arrived = Decoder(_ANY_SIZE), Decoder(_ANY_SIZE)

    @property
    def agree(self) -> bool:
        """True when a receiver is in step again: the same time and the same row."""
        states = [(decoder.time_us, decoder.row) for decoder in (self._sent, self._arrived)]
        return states[0] == states[1]

    def of(self, transfer: Transfer, arriving: SentWords) -> Transfer:
        """Return `transfer` with what arrives in place of its data, and with the events and edges that survive."""
        original = SentWords.of(transfer.data)
        sent, arrived = self._sent.feed(transfer.data), self._arrived.feed(arriving.words.tobytes())
        events = _same(_columns(original, sent), _columns(arriving, arrived), len(original.words))
        edges = _same(_marks(original, sent), _marks(arriving, arrived), len(original.words))
        return replace(
            transfer,
            data=arriving.data,
            events=transfer.events[events[is_column(original.words)]],
            edges=transfer.edges[edges[_is_mark(original.words)]],
        )


def _columns(sent: SentWords, decoded: Decoded) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return the origin of each event word, and the events."""
    return sent.origin[is_column(sent.words)], decoded.events


def _marks(sent: SentWords, decoded: Decoded) -> tuple[npt.NDArray[np.int64], npt.NDArray[np.void]]:
    """Return the origin of each edge's word, and their times and codes."""
    marks = decoded.specials[_is_mark(decoded.specials["code"])]
    return sent.origin[_is_mark(sent.words)], marks[["t", "code"]]


def _same(
    sent: tuple[npt.NDArray[np.int64], npt.NDArray[np.void]],
    arrived: tuple[npt.NDArray[np.int64], npt.NDArray[np.void]],
    words: int,
) -> Mask:
    """Return for each word sent whether it arrives and means the same, (words,)."""
    (at, meant), (origin, told) = sent, arrived
    index = np.full(words, -1)
    index[at] = np.arange(len(at))
    known = origin >= 0
    origin, told = origin[known], told[known]
    good = np.zeros(words, np.bool_)
    good[origin[told == meant[index[origin]]]] = True
    return good


def _is_mark(words: Words) -> Mask:
    return np.isin(words, _MARKS)
