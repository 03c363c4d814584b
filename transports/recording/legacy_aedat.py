"""AEDAT 2.0 and 3.1 files; the bytes are those of `firmware_protocol.recordings`."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TypeVar

from firmware_protocol.recordings.aedat import (
    Aedat2Decoder,
    Aedat31Decoder,
    Words,
    aedat2_header,
    aedat31_header,
    edge_words,
    encode_aedat31,
    encode_frame,
    encode_imu,
    event_words,
    frame_words,
    guarded_start,
    imu_words,
    packed,
    parse_aedat2_header,
    parse_aedat31_header,
)
from transports.recording.part import Facts, Part, RecordingError

_PIECE_BYTES = 1 << 19
T = TypeVar("T")
_MOST_HEADER = 1 << 22  # jAER writes all its preferences: 2100 lines


class Aedat2Writer:
    """Writer of events, pin events, IMU samples and frames in jAER's layout, of a sensor of `facts.size`.

    A frame is the reset reads of its pixels, at the start of its exposure, and their signal reads at its end, which
    wait until all earlier data have arrived.
    """

    def __init__(self, path: Path, facts: Facts) -> None:
        self._size = facts.size or (0, 0)
        self._file = path.open("wb", buffering=1 << 16)
        self._file.write(aedat2_header(self._size, facts.unix_us))
        self._signal: list[Words] = []
        self._is_start = True

    def write(self, part: Part) -> None:
        """Append records; none of the next part is earlier."""
        reset = []
        for frame in part.frames:
            reads = frame_words(frame, self._size[1])
            reset.append(reads[0])
            self._signal.append(reads[1])
        words = [edge_words(part.edges), imu_words(part.imu), *reset, event_words(part.events, self._size)]
        until_us = max((int(one["t"][-1]) for one in words if len(one)), default=0)
        due = [one for one in self._signal if int(one["t"][0]) <= until_us]
        self._signal = [one for one in self._signal if int(one["t"][0]) > until_us]
        self._append([*words[:2], *due, *words[2:]])

    def _append(self, words: list[Words]) -> None:
        records = packed(words)
        self._file.write(guarded_start(records) if self._is_start else records)
        self._is_start = self._is_start and not records
        self._file.flush()

    def close(self) -> None:
        """Write the waiting records and close the file."""
        try:
            self._append(self._signal)
        finally:
            self._file.close()


class Aedat2Reader:
    """Reader of events, pin events, IMU samples and frames; `size` is the sensor's if the file does not give it."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        with path.open("rb") as file:
            self._start, told, unix_us = _parsed(parse_aedat2_header, file.read(_MOST_HEADER))
        if not (size or told):
            raise RecordingError("it does not contain the size of its sensor: give --size, such as 346x260")
        self.facts = Facts(size or told, "aedat2", unix_us, _STREAMS)

    def parts(self) -> Iterator[Part]:
        """Yield events, and raise RecordingError at the end if many were outside the sensor."""
        decoder = Aedat2Decoder(self.facts.size or (0, 0))
        for data in _pieces(self._path, self._start):
            yield decoder.decode(data)
        if decoder.outside:
            raise RecordingError(
                f"{decoder.outside} events lie outside {self.facts.size} and are left out: give --size"
            )


class Aedat31Writer:
    """Writer of events, special events, IMU samples and frames in cAER's layout."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._file = path.open("wb", buffering=1 << 16)
        started = time.strftime("%Y-%m-%d %H:%M:%S (TZ+0000)", time.gmtime(facts.unix_us // 1_000_000))
        self._file.write(aedat31_header(facts.camera, started))

    def write(self, part: Part) -> None:
        """Append packets."""
        self._file.write(encode_aedat31(part.events, part.edges) + encode_imu(part.imu))
        for frame in part.frames:
            self._file.write(encode_frame(frame))
        self._file.flush()

    def close(self) -> None:
        """Close the file."""
        self._file.close()


class Aedat31Reader:
    """Reader of events, special events, IMU samples and frames; the file does not give the size of its sensor."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._path = path
        with path.open("rb") as file:
            self._start, source = _parsed(parse_aedat31_header, file.read(_MOST_HEADER))
        known = next((s for name, s in _SIZES.items() if source.upper().startswith(name)), None)
        self.facts = Facts(size or known, source or "aedat31", streams=_STREAMS)

    def parts(self) -> Iterator[Part]:
        """Yield the contents of whole packets."""
        decoder = Aedat31Decoder()
        for data in _pieces(self._path, self._start):
            try:
                part = decoder.decode(data)
            except ValueError as error:
                raise RecordingError(f"it is damaged: {error}") from error
            yield part


_STREAMS = frozenset({"edges", "imu", "frames"})  # possible streams: only reading the whole file shows if they exist
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
