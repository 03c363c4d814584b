"""Readers of files of events alone, whose decoders are in `firmware_protocol.recordings`: DAT, Event Stream, tables."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Protocol

from firmware_protocol.events import Events
from firmware_protocol.recordings.event_table import EventTable, TableForm
from transports.recording.part import Facts, Part, RecordingError, Size

_HEAD_BYTES = 1 << 16
_PIECE_BYTES = 1 << 19


class _Decoder(Protocol):
    start: int
    size: Size | None
    remarks: tuple[str, ...]
    damage: str

    def decode(self, data: bytes, /) -> Events: ...
    def end(self) -> Events: ...


class _EventReader:
    """Reader of events in pieces, with a decoder of any class.

    Parameters
    ----------
    open_decoder : maker of the decoder from the first bytes of the file; raises ValueError for another file.
    size : (width, height) of the sensor, for a file without it.
    camera : name of the camera; empty: none.
    """

    def __init__(
        self,
        path: Path,
        size: Size | None,
        open_decoder: Callable[[bytes], _Decoder],
        camera: str,
    ) -> None:
        self._path = path
        with path.open("rb") as file:
            try:
                self._decoder = open_decoder(file.read(_HEAD_BYTES))
            except ValueError as error:
                raise RecordingError(str(error)) from error
        self.facts = Facts(self._decoder.size or size, camera, streams=frozenset(), remarks=self._decoder.remarks)

    def parts(self) -> Iterator[Part]:
        """Yield the events; raises RecordingError after those before a damaged line or record."""
        decoder = self._decoder
        with self._path.open("rb") as file:
            file.seek(decoder.start)
            while not decoder.damage and (data := file.read(_PIECE_BYTES)):
                yield Part(decoder.decode(data))
        if not decoder.damage:
            yield Part(decoder.end())
        if decoder.damage:
            raise RecordingError(decoder.damage)


class DatReader(_EventReader):
    """Reader of DAT with change-detection events."""

    def __init__(self, path: Path, size: Size | None) -> None:
        from firmware_protocol.recordings.event_files import DatDecoder  # loads numba, which tables do not need

        super().__init__(path, size, DatDecoder, "dat")


class EsReader(_EventReader):
    """Reader of Event Stream files of DVS events."""

    def __init__(self, path: Path, size: Size | None) -> None:
        from firmware_protocol.recordings.event_files import EventStreamDecoder

        super().__init__(path, size, EventStreamDecoder, "es")


class CsvReader(_EventReader):
    """Reader of tables of text."""

    def __init__(self, path: Path, size: Size | None, form: TableForm | None = None) -> None:
        super().__init__(path, size, lambda head: EventTable(head, form), "csv")
