"""Readers of AEDAT 4.0 and of tables of text, and how a decoder of `firmware_protocol.recordings` reads a file.

All readers refuse a finished AEDAT 4.0 file that was cut, because its header refers to a table that is missing.
`recover_aedat4` makes a copy whose header states that there is none, and which ends with the last whole packet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, TypeVar

from firmware_protocol.recordings.aedat4 import KINDS, MAGIC, Aedat4Decoder, Aedat4Head, packet_at
from firmware_protocol.recordings.event_table import EventTable, TableForm
from firmware_protocol.recordings.part import Facts, Part
from transports.needs import install_command
from transports.recording.part import LibraryMissing, RecordingError, Size
from transports.registry import imported

_HEAD_BYTES = 1 << 16
_PIECE_BYTES = 1 << 19
T = TypeVar("T")


def opened(open_decoder: Callable[[bytes], T], path: Path, head_bytes: int) -> T:
    """Return what `open_decoder` makes of the first bytes of a file; its ValueError becomes RecordingError."""
    with path.open("rb") as file:
        try:
            return open_decoder(file.read(head_bytes))
        except ValueError as error:
            raise RecordingError(str(error)) from error


def decoded(decoder: Any, path: Path, start: int) -> Iterator[Any]:
    """Yield the content of a file from the offset `start` on; raises RecordingError after that before damaged data.

    `decoder` returns by `decode` what the next bytes complete, without bytes at the end of the file. Its `damage`, a
    reason, ends the data; its `rest` are bytes of a record that is not complete.
    """
    with path.open("rb") as file:
        file.seek(start)
        for data in chain(iter(partial(file.read, _PIECE_BYTES), b""), [b""]):
            yield decoder.decode(data)
            if decoder.damage:
                raise RecordingError(decoder.damage)
    check_end(len(decoder.rest))


def check_end(rest_bytes: int) -> None:
    """Raise RecordingError if bytes of a record that is not complete are left."""
    if rest_bytes:
        raise RecordingError(f"it is cut: {rest_bytes} octets of a cut record at the end")


class EventReader:
    """Reader of a file of events alone, with a decoder that `open_decoder` makes of its first bytes and `form`."""

    def __init__(
        self, open_decoder: Callable[..., Any], camera: str, path: Path, size: Size | None, *form: TableForm | None
    ) -> None:
        self._path = path
        self._decoder = opened(lambda head: open_decoder(head, *form), path, _HEAD_BYTES)
        self.facts = Facts(self._decoder.size or size, camera, streams=frozenset(), remarks=self._decoder.remarks)

    def parts(self) -> Iterator[Part]:
        """Yield the events; raises RecordingError after those before a damaged line or record."""
        return map(Part, decoded(self._decoder, self._path, self._decoder.start))


CsvReader = partial(EventReader, EventTable, "csv")


_AEDAT4_HEAD_BYTES = len(MAGIC) + 4 + (1 << 24)
_MOST_PACKET = 1 << 28  # of decompressed bytes: 16 million events


class Aedat4Reader:
    """Reader of the first stream of events and its companions."""

    def __init__(self, path: Path, size: Size | None) -> None:
        self._path = path
        self._decoder = opened(lambda data: Aedat4Decoder(Aedat4Head(data)), path, _AEDAT4_HEAD_BYTES)
        self._open_packet = _decompressor_of(self._decoder.head.compression)
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
        size, head = self._path.stat().st_size, self._decoder.head
        left = head.packets_end(size) - head.packets_at
        with self._path.open("rb") as file:
            file.seek(head.packets_at)
            while packet := packet_at(start := file.read(8), left):
                left -= packet
                yield self._part(int.from_bytes(start[:4], "little"), file.read(packet - 8))
                if self._decoder.damage:
                    raise RecordingError(self._decoder.damage)
        if left or head.table_at > size:
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
    missing = install_command("files") if compression < 3 else "pip install backports.zstd"
    raise LibraryMissing(f"its packets are compressed: {missing}")


def library_of(path: Path) -> str:
    """Return the optional package that decompresses an AEDAT 4.0 file; "" for none, as for each other file."""
    with suppress(OSError, RecordingError):
        return "lz4" if opened(Aedat4Head, path, _AEDAT4_HEAD_BYTES).compression in (1, 2) else ""
    return ""


_COPY_BYTES = 1 << 20


@dataclass(frozen=True)
class Saved:
    """Result of a recovery: number of packets, their bytes, and bytes omitted at the end."""

    packets: int
    kept_bytes: int
    left_bytes: int


def recover_aedat4(source: Path, target: Path) -> Saved:
    """Copy the whole packets of an AEDAT 4.0 file; raises RecordingError if the header is damaged, or OSError."""
    head = opened(Aedat4Head, source, _AEDAT4_HEAD_BYTES)
    packets_bytes = head.packets_end(source.stat().st_size) - head.packets_at
    packets = kept = 0
    with source.open("rb") as file, target.open("wb") as copy:
        file.seek(head.packets_at)
        copy.write(head.unfinished())
        while size := packet_at(start := file.read(8), packets_bytes - kept):
            copy.write(start)
            for place in range(8, size, _COPY_BYTES):
                copy.write(file.read(min(_COPY_BYTES, size - place)))
            packets += 1
            kept += size
    return Saved(packets, kept, packets_bytes - kept)
