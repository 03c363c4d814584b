"""AEDAT 2.0 and 3.1 files; the bytes are those of `firmware_protocol.recordings`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from firmware_protocol.recordings.aedat2 import (
    Aedat2Decoder,
    aedat2_header,
    encode_aedat2,
    guarded_start,
    parse_aedat2_header,
)
from firmware_protocol.recordings.aedat31 import Aedat31Decoder, aedat31_header, encode_aedat31, parse_aedat31_header
from transports.recording.part import Facts, Part, RecordingError

__all__ = ["Aedat2Reader", "Aedat2Writer", "Aedat31Reader", "Aedat31Writer"]

_PIECE_BYTES = 1 << 19
T = TypeVar("T")
_MOST_HEADER = 1 << 22  # jAER writes all its preferences: 2100 lines


class Aedat2Writer:
    """Writes events and pin events as jAER does, of a sensor of `facts.size`."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._size = facts.size or (0, 0)
        self._file = path.open("wb", buffering=1 << 16)
        self._file.write(aedat2_header(self._size, facts.unix_us))
        self._is_start = True

    def write(self, part: Part) -> None:
        """Append records."""
        records = encode_aedat2(part.events, self._size, part.edges)
        self._file.write(guarded_start(records) if self._is_start else records)
        self._is_start = self._is_start and not records
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Aedat2Reader:
    """Reads events and pin events; `size` is that of the sensor where the file does not tell."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        with path.open("rb") as file:
            self._start, told, unix_us = _parsed(parse_aedat2_header, file.read(_MOST_HEADER))
        if not (size or told):
            raise RecordingError("it does not tell the size of its sensor: give --size, such as 346x260")
        self.facts = Facts(size or told, "aedat2", unix_us)

    def parts(self) -> Iterator[Part]:
        """Yield events, and raise RecordingError at the end where many lay outside the sensor."""
        decoder = Aedat2Decoder(self.facts.size or (0, 0))
        for data in _pieces(self._path, self._start):
            yield Part(*decoder.decode(data))
        if decoder.outside:
            raise RecordingError(
                f"{decoder.outside} events lie outside {self.facts.size} and are left out: give --size"
            )


class Aedat31Writer:
    """Writes events and special events as cAER does."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._file = path.open("wb", buffering=1 << 16)
        started = _date(facts.unix_us, "%Y-%m-%d %H:%M:%S (TZ+0000)") or "1970-01-01 00:00:00 (TZ+0000)"
        self._file.write(aedat31_header(facts.camera, started))

    def write(self, part: Part) -> None:
        """Append packets."""
        self._file.write(encode_aedat31(part.events, part.edges))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Aedat31Reader:
    """Reads events and special events; the file does not tell the size of its sensor."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        with path.open("rb") as file:
            self._start, source = _parsed(parse_aedat31_header, file.read(_MOST_HEADER))
        known = next((s for name, s in _SIZES.items() if source.upper().startswith(name)), None)
        self.facts = Facts(size or known, source or "aedat31")

    def parts(self) -> Iterator[Part]:
        """Yield the events of whole packets."""
        decoder = Aedat31Decoder()
        for data in _pieces(self._path, self._start):
            try:
                part = Part(*decoder.decode(data))
            except ValueError as error:
                raise RecordingError(f"it is damaged: {error}") from error
            yield part


_SIZES = {"DAVIS346": (346, 260), "DAVIS240": (240, 180), "DVS128": (128, 128), "DAVIS640": (640, 480)}


def _parsed(parse: Callable[[bytes], T], head: bytes) -> T:
    try:
        return parse(head)
    except ValueError as error:
        raise RecordingError(str(error)) from error


def _pieces(path: Path, start: int) -> Iterator[bytes]:
    with path.open("rb") as file:
        file.seek(start)
        while data := file.read(_PIECE_BYTES):
            yield data


def _date(unix_us: int, form: str) -> str:
    return time.strftime(form, time.gmtime(unix_us // 1_000_000)) if unix_us else ""
