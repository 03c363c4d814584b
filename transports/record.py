"""What was delivered, written to a file event by event.

The file is a NumPy `.npz`:

    events   EVENT[n]   in device time: microseconds since the device's clock was last zero
    resets   int64[k]   indices into `events` at which that clock started anew (a timestamp reset, or a new start)

A client's view after it reset the camera's timestamps is `events[resets[-1]:]`. While the run lasts the events lie in a
plain file beside it (`.part`), so that memory does not grow with the run and a killed run leaves its data.
"""

from __future__ import annotations

from pathlib import Path
from typing import BinaryIO

import numpy as np

from firmware_protocol.events import EVENT, Events, empty_events

__all__ = ["Recorder", "load_record", "save_record"]


class Recorder:
    """Appends delivered events; `close` makes the `.npz`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._part = path.with_suffix(path.suffix + ".part")
        self._file: BinaryIO = self._part.open("wb")
        self._count = 0
        self._resets: list[int] = []

    def append(self, events: Events, *, restarted: bool = False) -> None:
        """Add events in device time; `restarted` when that time began anew before them."""
        if restarted or not self._count:
            self._resets.append(self._count)
        self._file.write(events.tobytes())
        self._count += len(events)

    def close(self) -> None:
        """Write the `.npz` and remove the raw file."""
        self._file.close()
        events = np.memmap(self._part, EVENT, "r") if self._count else empty_events()
        save_record(self.path, events, self._resets)
        del events
        self._part.unlink()


def save_record(path: Path, events: Events, resets: list[int]) -> None:
    """Write events (n,) in device time and the indices at which that time started anew."""
    with path.open("wb") as file:
        np.savez(file, events=events, resets=np.array(resets, np.int64))


def load_record(path: Path) -> tuple[Events, list[int]]:
    """Read a record: events (n,) EVENT in device time, and the indices at which device time started anew."""
    with np.load(path) as file:
        return file["events"], [int(i) for i in file["resets"]]
