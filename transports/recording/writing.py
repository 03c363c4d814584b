"""A recording in any format as it is written: in pieces of a good size, in the order of time, one file for each clock.

A format holds one time that never goes back. When the camera's clock starts anew, so does the file: NAME.aedat4 is
followed by NAME-clock2.aedat4.
"""

from __future__ import annotations

import dataclasses
import shutil
from collections import deque
from pathlib import Path

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import join_events
from firmware_protocol.events import Events
from transports.recording.format import Format, with_addition
from transports.recording.part import Facts, Part, RecordingError, Writer

__all__ = ["RecordingFile"]

_PIECE_EVENTS = 1 << 14
_HELD_PARTS = 4


class RecordingFile:
    """Writes parts to `path`, and to further files where the clock starts anew.

    Parameters
    ----------
    hold : whether edges may come after later events, as the streams of a file do, each in packets of its own: what came
        with the last four parts with events then waits for them.

    Attributes
    ----------
    paths : the files.
    events, edges : how many are in them.
    late_edges : edges that came when later events had been written, and are left out.
    """

    def __init__(self, path: Path, form: Format, facts: Facts, *, hold: bool = False) -> None:
        self._first = path
        self._form = form
        self._facts = facts
        self._hold = hold
        self.paths: list[Path] = []
        self.events = self.edges = self.late_edges = 0
        self._writer: Writer | None = None
        self._begin()

    def _begin(self) -> None:
        number = len(self.paths) + 1
        path = self._first if number == 1 else with_addition(self._first, f"clock{number}")
        self._waiting: list[Events] = []
        self._waiting_edges: list[Edges] = []
        self._count = 0
        self._starts_us: deque[int] = deque([0] * _HELD_PARTS, _HELD_PARTS)
        self._last_us = self._newest_us = self._written_us = 0
        self._is_new = True
        self._writer = self._form.open_writer(path, self._facts)
        self.paths.append(path)

    def restart(self, unix_us: int) -> None:
        """Begin anew with a clock that is zero at the Unix time `unix_us`, 0 where that is not known."""
        if self._is_new and unix_us == self._facts.unix_us:
            return
        self.flush()
        self._facts = dataclasses.replace(self._facts, unix_us=unix_us)
        is_new = self._is_new
        self.close()
        if is_new:  # nothing has been written, so that the same file serves
            _remove(self.paths.pop())
        self._begin()

    def write(self, part: Part) -> None:
        """Append a part; raises RecordingError for what the format cannot hold, and what its writer raises."""
        if len(part.events):
            self._check(part.events)
            self._waiting.append(part.events)
            self._count += len(part.events)
            self._starts_us.append(int(part.events["t"][0]))
            self._last_us = int(part.events["t"][-1])
            self._newest_us = max(self._newest_us, self._last_us)
        if len(part.edges) and "edges" in self._form.holds:
            self._waiting_edges.append(part.edges)
            self._newest_us = max(self._newest_us, int(part.edges["t"][-1]))
        if (len(part.imu) and "imu" in self._form.holds) or (part.frames and "frames" in self._form.holds):
            self._put(dataclasses.replace(part, events=part.events[:0], edges=part.edges[:0]))
        until_us = self._starts_us[0] - 1 if self._hold else self._newest_us
        if (self._count >= _PIECE_EVENTS and not self._hold) or until_us - self._written_us >= self._form.piece_us:
            self.flush(until_us if self._hold else None)

    def _check(self, events: Events) -> None:
        t = events["t"]
        before = np.concatenate((np.array([self._last_us], np.uint64), t[:-1]))
        back = np.flatnonzero(t < before)
        if len(back):
            k = int(back[0])
            raise RecordingError(f"an event goes back in time, from {before[k]} to {t[k]} us: a file holds one clock")
        if int(t[-1]) >= self._form.until_us:
            raise RecordingError(f"{self._form.title} holds no time beyond {self._form.until_us // 1_000_000} s")
        width, height = self._facts.size or (0, 0)
        if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
            raise RecordingError(f"an event lies outside the sensor of {width} x {height} pixels")

    def flush(self, until_us: int | None = None) -> None:
        """Write what waits, up to a time if one is given."""
        edges = np.concatenate([empty_edges(), *self._waiting_edges])
        if len(edges) > 1 and bool((edges["t"][1:] < edges["t"][:-1]).any()):
            edges = edges[np.argsort(edges["t"], kind="stable")]
        events = join_events(self._waiting)
        cut = (len(events), len(edges))
        if until_us is not None:
            limit = np.uint64(max(0, until_us))
            cut = (int(np.searchsorted(events["t"], limit, "right")), int(np.searchsorted(edges["t"], limit, "right")))
        self._waiting, self._waiting_edges = [events[cut[0] :]], [edges[cut[1] :]]
        self._count = len(events) - cut[0]
        self._put_in_order(events[: cut[0]], edges[: cut[1]])

    def _put_in_order(self, events: Events, edges: Edges) -> None:
        if not len(events) and not len(edges):
            return
        late = int(np.searchsorted(edges["t"], np.uint64(self._written_us)))
        self.late_edges += late
        edges = edges[late:]
        self._written_us = max([self._written_us, *(int(t[-1]) for t in (events["t"], edges["t"]) if len(t))])
        self._put(Part(events, edges))
        self.events += len(events)
        self.edges += len(edges)

    def _put(self, part: Part) -> None:
        if self._writer is not None:
            self._is_new = False
            self._writer.write(part)

    def close(self) -> None:
        """Write what waits and finish the file."""
        writer = self._writer
        if writer is None:
            return
        try:
            self.flush()
        finally:
            self._writer = None
            writer.close()


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path)
    elif path.is_file():  # a device stays
        path.unlink()
