"""Recordings of unknown origin, read part by part in a child process (see `guarded_reader`).

The child's memory does not grow with the file. Damaged data become a RecordingError, after all data before them. Events
that go back in time or lie outside the sensor are damage in every format, because none of them has such events.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np

from transports.guarded_reader import ForeignFileError, GuardedReader, Limits
from transports.recording.format import FORMATS, Format, format_to_read, reason
from transports.recording.part import (
    Facts,
    LibraryMissing,
    Part,
    PipeReader,
    RecordingError,
    encoded_facts,
    encoded_part,
    facts_of,
    wrong_event,
)

_MOST_EVENTS = 1 << 16  # in one message


class OpenRecording:
    """Recording that is open in a child process; a context manager.

    Parameters
    ----------
    size : tuple[int, int] or None
        (width, height) of the sensor, for files without it.
    strict : bool
        False: events that go back in time or lie outside the sensor are no error.

    Raises
    ------
    RecordingError
        It cannot be read. LibraryMissing if its library is missing. OSError if it cannot be opened.

    Attributes
    ----------
    format, facts
        Its format, and the facts available before its first event.
    """

    def __init__(self, path: Path, size: tuple[int, int] | None = None, *, strict: bool = True) -> None:
        self._strict = strict
        self.format: Format = format_to_read(path)
        arguments = (f"{__name__}:read_messages", path, self.format.name, size)
        self._reader = GuardedReader(*arguments, limits=Limits.in_pieces(path))
        self._messages = self._received()
        try:
            self.facts: Facts = facts_of(next(self._messages))
        except BaseException:
            self.close()
            raise

    def parts(self) -> Iterator[Part]:
        """Yield all parts; raises RecordingError after the data before damaged data."""
        count = last_us = 0
        size = self.facts.size or (1 << 16, 1 << 16)
        for part in self._messages:
            events = part.events
            if self._strict and (wrong := wrong_event(events, last_us, size)) is not None:
                yield Part(events[: wrong[0]])
                raise RecordingError(f"event {count + wrong[0]} {wrong[1]}; read_events with strict=False returns all")
            yield part
            count, last_us = count + len(events), int(events["t"][-1]) if len(events) else last_us

    def _received(self) -> Iterator[Any]:
        """Yield the facts and the parts; raises RecordingError."""
        pipe = PipeReader()
        try:
            for values in self._reader.values():
                yield from pipe.feed(values["messages"].tobytes())
        except ForeignFileError as error:
            raise (LibraryMissing if error.lacks else RecordingError)(str(error)) from None

    def close(self) -> None:
        """End the child process."""
        self._reader.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


def read_messages(path: Path, form: str, size: list[int] | None) -> Iterator[dict[str, Any]]:
    """Yield the messages of a recording's facts and parts (see `part`), in the child; raises RecordingError."""
    try:
        reader = FORMATS[form].open_reader(path, None if size is None else (size[0], size[1]))
        yield _message(encoded_facts(reader.facts))
        for part in reader.parts():
            for start in range(0, max(1, len(part.events)), _MOST_EVENTS):
                events = part.events[start : start + _MOST_EVENTS]
                piece = Part(events) if start else Part(events, part.edges, part.imu, part.frames)
                yield _message(encoded_part(piece))
    except (RecordingError, GeneratorExit):
        raise
    except BaseException as error:
        raise RecordingError(reason(error)) from error


def _message(pieces: list[bytes]) -> dict[str, Any]:
    return {"messages": np.frombuffer(b"".join(pieces), np.uint8)}
