"""What can be saved of a recording that was cut: whole packets of AEDAT 4.0, and the raw events of an `.npz` record.

A finished AEDAT 4.0 file that was cut is refused by all readers, as its header tells of a table that is not there. The
copy says that there is none, as a file does while it is written, and ends with the last whole packet.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

import numpy as np

from firmware_protocol.events import EVENT
from firmware_protocol.recordings.aedat4_frame import MAGIC, Aedat4Head, packet_at
from transports.recording.part import Facts, Part, RecordingError

__all__ = ["RawEvents", "Saved", "recover_aedat4"]

_MOST_HEADER = 1 << 24
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True)
class Saved:
    """What a recovery saved: packets, their bytes, and bytes that were left out at the end."""

    packets: int
    kept_bytes: int
    left_bytes: int


def recover_aedat4(source: Path, target: Path) -> Saved:
    """Copy the whole packets of an AEDAT 4.0 file; raises RecordingError where the header is damaged, or OSError."""
    with source.open("rb") as file:
        try:
            head = Aedat4Head(file.read(len(MAGIC) + 4 + _MOST_HEADER))
        except ValueError as error:
            raise RecordingError(str(error)) from error
        size = source.stat().st_size
        end = head.table_at if head.packets_at <= head.table_at <= size else size
        file.seek(head.packets_at)
        with target.open("wb") as copy:
            copy.write(head.unfinished())
            packets, kept = _copied(file, copy, end - head.packets_at)
    return Saved(packets, kept, end - head.packets_at - kept)


def _copied(file: BinaryIO, copy: BinaryIO, left: int) -> tuple[int, int]:
    packets = kept = 0
    while size := packet_at(head := file.read(8), left - kept):
        copy.write(head)
        for start in range(8, size, _PIECE_BYTES):
            copy.write(file.read(min(_PIECE_BYTES, size - start)))
        packets += 1
        kept += size
    return packets, kept


class RawEvents:
    """Reads the `.part` file that stays of an `.npz` record whose run was killed, from the last clock on."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self.facts = Facts(size, "record", streams=frozenset())
        self._path = path

    def parts(self) -> Iterator[Part]:
        """Yield the whole events; where time goes back, the clock began anew, and what was before is left out."""
        count = self._path.stat().st_size // EVENT.itemsize
        if not count:
            return
        events = np.memmap(self._path, EVENT, "r", shape=(count,))
        step = _PIECE_BYTES // EVENT.itemsize
        back = [
            int(k) + start + 1
            for start in range(0, count, step)
            for k in np.flatnonzero(np.diff(events["t"][start : start + step + 1].astype(np.int64)) < 0)
        ]
        for start in range(back[-1] if back else 0, count, step):
            yield Part(np.array(events[start : start + step]))
