"""Events of a recording, in any format that `record` writes: all in one array, or piece by piece."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from firmware_protocol.events import Events, join_events
from transports.recording.files import OpenRecording
from transports.recording.part import RecordingError, Size


def read_events(path: str | Path, *, size: Size | None = None, strict: bool = True) -> Events:
    """Return all events of a recording.

    Parameters
    ----------
    path : file, or folder of a ROS 2 bag, in any format of docs/recordings.md. Its first bytes decide which one.
    size : (width, height) of the sensor, for a format that does not contain it.
    strict : False: return the events of a damaged file that go back in time or lie outside the sensor, too.

    Returns
    -------
    (n,) EVENT, sorted unless `strict` is False, t in us since the start of the recording; of a `.npz` record, those
    since the last restart of the camera's clock (`load_record` returns the others too).

    Raises
    ------
    RecordingError
        The file is damaged or in none of the formats, or the library that reads its format is missing. A file whose
        events go back in time or lie outside its sensor is damaged.
    OSError
        It cannot be opened.
    """
    return join_events(list(iter_events(path, size=size, strict=strict))).copy()


def iter_events(path: str | Path, *, size: Size | None = None, strict: bool = True) -> Iterator[Events]:
    """Yield the events of a recording piece by piece, so that memory does not grow with the file.

    Arguments and errors are those of `read_events`. A damaged file raises RecordingError after the events before the
    damage. Another process reads the file; closing the iterator ends it.

    Yields
    ------
    (n,) EVENT, n > 0, read-only.
    """
    file = Path(path)
    try:
        with OpenRecording(file, size, strict=strict) as recording:
            yield from (part.events for part in recording.parts() if len(part.events))
    except RecordingError as error:
        raise type(error)(f"{file}: {error}") from error
