"""Readers of AEDAT 4.0, DAT, Event Stream and tables of text, with the decoders of `firmware_protocol.recordings`."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any, Protocol

from firmware_protocol.events import Events
from firmware_protocol.recordings.aedat4 import KINDS, MAGIC, Aedat4Decoder, Aedat4Head, packet_at
from firmware_protocol.recordings.event_table import EventTable, TableForm
from transports.needs import install_command
from transports.recording.part import Facts, LibraryMissing, Part, RecordingError, Size
from transports.registry import imported

_HEAD_BYTES = 1 << 16
_PIECE_BYTES = 1 << 19


class _Decoder(Protocol):
    start: int
    damage: str

    @property
    def size(self) -> Size | None: ...
    @property
    def remarks(self) -> tuple[str, ...]: ...
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


_MOST_HEADER = 1 << 24
_MOST_PACKET = 1 << 28  # of decompressed bytes: 16 million events


class Aedat4Reader:
    """Reader of the first stream of events and its companions."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self._path = path
        try:
            with path.open("rb") as file:
                self._head = Aedat4Head(file.read(len(MAGIC) + 4 + _MOST_HEADER))
            self._decoder = Aedat4Decoder(self._head)
        except ValueError as error:
            raise RecordingError(str(error)) from error
        self._open_packet = _decompressor_of(self._head.compression)
        info, kinds = self._decoder.info, list(self._decoder.kinds.values())
        width, height = (int(text) if text.isdecimal() else 0 for text in map(info.get, ("sizeX", "sizeY"), ("", "")))
        size = (width, height) if width and height else size
        streams = frozenset(KINDS[kind] for kind in kinds if kind in KINDS and kind != "EVTS")
        camera = info.get("source") or "aedat4"
        further = f"it has {kinds.count('EVTS')} streams of events, of which stream {self._decoder.events} is read"
        remarks = (further,) if kinds.count("EVTS") > 1 else ()
        self.facts = Facts(size, camera, self._decoder.start_us, streams, remarks=remarks)

    def parts(self) -> Iterator[Part]:
        """Yield packets; raises RecordingError at the first damaged one, after the data before its damage."""
        size = self._path.stat().st_size
        is_whole = self._head.table_at <= size
        end = self._head.table_at if self._head.packets_at <= self._head.table_at <= size else size
        left = end - self._head.packets_at
        with self._path.open("rb") as file:
            file.seek(self._head.packets_at)
            while packet := packet_at(head := file.read(8), left):
                left -= packet
                yield self._part(int.from_bytes(head[:4], "little"), file.read(packet - 8))
                if self._decoder.damage:
                    raise RecordingError(self._decoder.damage)
        if left or not is_whole:
            advice = "`evstim recover IN OUT` makes a file that others read"
            raise RecordingError(f"it is cut: {left} octets of a cut record at the end; {advice}")

    def _part(self, stream: int, payload: bytes) -> Part:
        try:
            if self._open_packet is not None:
                packet = self._open_packet()
                payload = packet.decompress(payload, max_length=_MOST_PACKET)
                if not packet.eof:
                    raise ValueError("a packet has no end")
            return self._decoder.decode(stream, payload)
        except (ValueError, RuntimeError, EOFError) as error:
            raise RecordingError(f"it is damaged: {error}") from error


_DECOMPRESSORS = {1: ("lz4.frame:LZ4FrameDecompressor",), 2: ("lz4.frame:LZ4FrameDecompressor",)} | dict.fromkeys(
    (3, 4), ("compression.zstd:ZstdDecompressor", "backports.zstd:ZstdDecompressor")
)


def _decompressor_of(compression: int) -> Any:
    """Return the class that decompresses a packet, None for none; raises RecordingError and LibraryMissing."""
    if compression == 0:
        return None
    if compression not in _DECOMPRESSORS:
        raise RecordingError(f"its packets have compression {compression}, which is not known")
    for path in _DECOMPRESSORS[compression]:
        with suppress(ImportError):
            return imported(path)
    raise LibraryMissing(f"its packets are compressed: {install_command('files')}")
