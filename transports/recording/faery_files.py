"""DAT, Event Stream and CSV files, written and read by faery.

Times stay unchanged (no t0 is subtracted): faery would begin each file at its first event. Event Stream counts rows
from the bottom, and faery's writer does not convert them. Readers are for a child process: faery panics at unexpected
data, see `guarded`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from faery.extension import csv, dat, es

from firmware_protocol.events import EVENT, Events
from transports.recording.part import Facts, Part, RecordingError

_COMMA = 44
_SIZE = (1280, 720)  # for a file without it: faery's own default
_DAT_EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("payload", "u1")])


class _Events:
    """Writer of events only, with an encoder of faery."""

    def __init__(self, encoder: Any) -> None:
        self._encoder = encoder
        encoder.__enter__()

    def write(self, part: Part) -> None:
        """Append the events."""
        if len(part.events):
            self._encoder.write(self._packet(part.events))

    def _packet(self, events: Events) -> Any:
        return events

    def close(self) -> None:
        """Finish the file."""
        self._encoder.__exit__(None, None, None)


class DatWriter(_Events):
    """Writer of DAT, version 2."""

    def __init__(self, path: Path, facts: Facts) -> None:
        super().__init__(dat.Encoder(path, version="dat2", event_type="cd", zero_t0=False, dimensions=facts.size))

    def _packet(self, events: Events) -> Any:
        return events.view(_DAT_EVENT)


class EsWriter(_Events):
    """Writer of Event Stream files, rows from the bottom."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._top = (facts.size or _SIZE)[1] - 1
        super().__init__(es.Encoder(path, event_type="dvs", zero_t0=False, dimensions=facts.size))

    def _packet(self, events: Events) -> Any:
        return _turned(events, self._top)


class CsvWriter(_Events):
    """Writer of lines t,x,y,on after a line with the names and the size."""

    def __init__(self, path: Path, facts: Facts) -> None:
        super().__init__(
            csv.Encoder(path, separator=_COMMA, header=True, dimensions=facts.size, enforce_monotonic=True)
        )


class _Decoded:
    """Reader of events with a decoder of faery."""

    def __init__(self, decoder: Any, size: tuple[int, int] | None, camera: str) -> None:
        self._decoder = decoder
        self.facts = Facts(size, camera, streams=frozenset())

    def parts(self) -> Iterator[Part]:
        """Yield the events, packet by packet."""
        with self._decoder as packets:
            for packet in packets:
                events = self._events(packet)
                if len(events):
                    yield Part(events)

    def _events(self, packet: Any) -> Events:
        return _as_events(packet)


class DatReader(_Decoded):
    """Reader of DAT with change-detection events."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        decoder = dat.Decoder(path, size or _SIZE, "dat2")
        if decoder.event_type != "cd":
            raise RecordingError(f"its events are of type {decoder.event_type!r}; change-detection events are read")
        super().__init__(decoder, decoder.dimensions, decoder.version)

    def _events(self, packet: Any) -> Events:
        events = np.zeros(len(packet), EVENT)
        for name in ("t", "x", "y"):
            events[name] = packet[name]
        events["on"] = packet["payload"] > 0
        return events


class EsReader(_Decoded):
    """Reader of Event Stream files of DVS events."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        decoder = es.Decoder(path, 0)
        if decoder.event_type != "dvs":
            raise RecordingError(f"its events are of type {decoder.event_type!r}; DVS events are read")
        super().__init__(decoder, decoder.dimensions, "es")

    def _events(self, packet: Any) -> Events:
        return _turned(_as_events(packet), (self.facts.size or _SIZE)[1] - 1)


class CsvReader(_Decoded):
    """Reader of lines t,x,y,on; the first line may give the size as our writer does: t,x@346,y@260,on."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        with path.open("rb") as file:
            head = file.readline(200)
        told = re.search(rb"x@(\d{1,5}),y@(\d{1,5})", head)
        has_header = not head[:1].isdigit()
        size = (int(told[1]), int(told[2])) if told else size
        decoder = csv.Decoder(
            path=path, dimensions=size or _SIZE, has_header=has_header, separator=_COMMA, t_index=0, x_index=1,
            y_index=2, on_index=3, t_scale=0.0, t0=0, on_value=b"1", off_value=b"0", skip_errors=False,
        )  # fmt: skip
        super().__init__(decoder, size, "csv")


def _as_events(packet: Any) -> Events:
    events: Events = packet.view(EVENT) if packet.dtype.itemsize == EVENT.itemsize else packet.astype(EVENT)
    return events


def _turned(events: Events, top: int) -> Events:
    turned = events.copy()
    turned["y"] = top - events["y"]
    return turned
