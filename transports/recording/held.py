"""Queues of records and frames, which are taken up to a time, in the order of time."""

from __future__ import annotations

from collections import deque
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EVENT, join_events
from transports.recording.part import Frame

__all__ = ["HeldFrames", "HeldRecords"]

_Records = npt.NDArray[Any]


class HeldRecords:
    """Queue of records of one stream with a time `t`, u64 us.

    Each piece is sorted; one may begin before the end of the preceding piece.
    """

    def __init__(self, dtype: np.dtype[Any]) -> None:
        self._dtype, self._none = dtype, np.zeros(0, dtype)
        self._pieces: deque[_Records] = deque()
        self._last_us = 0
        self._is_sorted = True

    def time_of(self, index: int) -> int | None:
        """Return the time of the waiting record at `index`; None if fewer wait."""
        self._sort()
        for piece in self._pieces:
            if index < len(piece):
                return int(piece["t"][index])
            index -= len(piece)
        return None

    def add(self, records: _Records) -> None:
        """Add a piece, (n,)."""
        if not len(records):
            return
        self._is_sorted = self._is_sorted and (not self._pieces or int(records["t"][0]) >= self._last_us)
        self._last_us = max(self._last_us, int(records["t"][-1]))
        self._pieces.append(records)

    def take(self, until_us: int) -> _Records:
        """Return the records up to `until_us`, (n,) in the order of time; records of equal time in order of arrival."""
        if not self._pieces:
            return self._none
        self._sort()
        taken = []
        while self._pieces and int(self._pieces[0]["t"][0]) <= until_us:
            piece = self._pieces.popleft()
            n = int(np.searchsorted(piece["t"], np.uint64(until_us), "right"))
            taken.append(piece[:n])
            if n < len(piece):
                self._pieces.appendleft(piece[n:])
                break
        return self._joined(taken)

    def _sort(self) -> None:
        if not self._is_sorted:
            records = self._joined(list(self._pieces))
            self._pieces = deque([records[np.argsort(records["t"], kind="stable")]])
            self._is_sorted = True

    def _joined(self, pieces: list[_Records]) -> _Records:
        if self._dtype == EVENT:
            return join_events(pieces)
        return np.concatenate([self._none, *pieces])


class HeldFrames:
    """Queue of frames, by the time of each."""

    def __init__(self) -> None:
        self._frames: list[Frame] = []

    def time_of(self, index: int) -> int | None:
        """Return the time of the waiting frame at `index`; None if fewer wait."""
        return self._frames[index].t_us if index < len(self._frames) else None

    def add(self, frames: tuple[Frame, ...]) -> None:
        """Add frames, in any order."""
        self._frames = sorted([*self._frames, *frames], key=_time_of)

    def take(self, until_us: int) -> tuple[Frame, ...]:
        """Return the frames up to `until_us`, in the order of time."""
        taken = tuple(frame for frame in self._frames if frame.t_us <= until_us)
        self._frames = self._frames[len(taken) :]
        return taken


def _time_of(frame: Frame) -> int:
    return frame.t_us
