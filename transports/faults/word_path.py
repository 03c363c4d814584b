"""Path of the words of a DAVIS346 through the faults, and the events and edges that survive it. Sans-I/O.

`WordPath` passes the words through the stages, and compares the result with the original until they agree again.

`Survivors` finds the events and edges that reach an intact receiver. Two decoders read: one the words that the camera
sent, the other those that arrive. An event or edge survives when its own word arrives and gives the same time, place
and polarity. A receiver that misses a wrap therefore has no event of the camera's until the next timestamp reset: all
its times are wrong. An additional byte at the end of a transfer is discarded, as libcaer does.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import numpy.typing as npt

from firmware_protocol.davis346.decoder import Decoded, Decoder
from firmware_protocol.davis346.settings import PRODUCT_ID, VENDOR_ID
from firmware_protocol.davis346.words import MAX_ADDRESS, Special, Words, is_column
from firmware_protocol.usb.device import Identity, Transfer
from transports.faults.words import SentWords, WordStage, inserted

__all__ = ["Survivors", "WordPath"]


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
    """Comparison of the words sent with the words that arrive, from its creation on."""

    def __init__(self) -> None:
        # Earlier words are the same for both, so both may begin at time zero and row zero.
        self._sent, self._arrived = Decoder(_ANY_SIZE), Decoder(_ANY_SIZE)

    @property
    def agree(self) -> bool:
        """True when a receiver is in step again: the same time and the same row."""
        states = [(decoder.time_us, decoder.row) for decoder in (self._sent, self._arrived)]
        return states[0] == states[1]

    def of(self, transfer: Transfer, arriving: SentWords) -> Transfer:
        """Return `transfer` with the arriving data, and with the events and edges that survive."""
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
    """Return for each word sent if it arrives with the same meaning, (words,)."""
    (at, meant), (origin, read) = sent, arrived
    index = np.full(words, -1)
    index[at] = np.arange(len(at))
    known = origin >= 0
    origin, read = origin[known], read[known]
    good = np.zeros(words, np.bool_)
    good[origin[read == meant[index[origin]]]] = True
    return good


def _is_mark(words: Words) -> Mask:
    return np.isin(words, _MARKS)


class WordPath:
    """Path of the words of one camera through the faults.

    Attributes
    ----------
    front
        Words that are inserted before the next transfer.
    """

    def __init__(self, camera: Identity) -> None:
        self._has_words = (camera.vendor_id, camera.product_id) == (VENDOR_ID, PRODUCT_ID)
        self._survivors: Survivors | None = None
        self._epoch_us = self._next_front = 0
        self.front: list[int] = []

    def needed(self, stages: Sequence[WordStage]) -> bool:
        """Return True if transfers have to take this path."""
        return self._has_words and bool(stages or self.front or self._survivors)

    def room(self, stages: Sequence[WordStage], max_bytes: int) -> int:
        """Return the number of bytes that the camera may send, so that the arriving transfer fits into `max_bytes`."""
        self._next_front = min(len(self.front), max_bytes // 4)  # half of a transfer at most
        max_bytes -= 2 * self._next_front
        for stage in reversed(stages):
            max_bytes = stage.room(max_bytes)
        return max_bytes

    def changed(self, transfer: Transfer, stages: Sequence[WordStage]) -> Transfer:
        """Return the transfer that arrives, with the events and edges that survive."""
        sent = SentWords.of(transfer.data)
        for stage in stages:
            sent = stage.change(sent)
        sent, self.front = inserted(sent, 0, self.front[: self._next_front]), self.front[self._next_front :]
        if self._survivors is None or transfer.epoch_us != self._epoch_us:
            # After a clock reset, a receiver without earlier data begins a new stream.
            self._survivors, self._epoch_us = Survivors(), transfer.epoch_us
        arrived = self._survivors.of(transfer, sent)
        if not stages and not self.front and self._survivors.agree:
            self._survivors = None
        return arrived
