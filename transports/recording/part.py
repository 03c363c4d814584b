"""Interfaces of recordings, and messages for their parts on a pipe to another process.

A message is a letter, a length, and bytes.

    E events   X edges   I IMU samples   F a frame: JSON head, newline, pixels
    R a restart of the clock: i64 Unix us   T a time that was reached: i64 us   H facts, Z the end: JSON
"""

from __future__ import annotations

import dataclasses
import json
import struct
from collections.abc import Iterator
from typing import Any, Protocol

import numpy as np

from firmware_protocol.events import EDGE, EVENT, Events
from firmware_protocol.recordings.part import IMU, Facts, Frame, Part

Size = tuple[int, int]
"""(width, height) of a sensor, pixels."""
MOST_PIXELS = 1 << 24
"""Pixels of the largest sensor that is simulated, 4096 x 4096; no event camera has as many."""


class RecordingError(Exception):
    """Error: a recording cannot be read or written; the message gives the reason, without the file's name."""


class DamagedRecording(RecordingError):
    """Error: a recording is cut or damaged before the first of its events."""


class LibraryMissing(RecordingError, ImportError):
    """Error: the optional package that reads or writes this format is not installed."""


class Writer(Protocol):
    """Writer of one file. Times increase and begin near zero: see `Facts.unix_us`."""

    def write(self, part: Part) -> None:
        """Append the data that the format holds; raises OSError, RecordingError, or the errors of its library."""
        ...

    def close(self) -> None:
        """Finish the file."""
        ...


class Reader(Protocol):
    """Reader of one file."""

    @property
    def facts(self) -> Facts:
        """Facts that are available before the first event."""
        ...

    def parts(self) -> Iterator[Part]:
        """Yield pieces of bounded size; raises RecordingError, OSError, or the errors of its library."""
        ...


_HEAD = struct.Struct("<cI")
_MOST_BYTES = 1 << 30
_FOREIGN = "the other process sends data that are no part of a recording"


class Restart(int):
    """Restart of the camera's clock: the Unix time, us, at which it is zero."""


class Reached(int):
    """Time of the camera's clock, us, before which no further event comes."""


def encoded_part(part: Part) -> list[bytes]:
    """Return the messages of a part; empty streams have none."""
    arrays = ((b"E", part.events), (b"X", part.edges), (b"I", part.imu))
    pieces = [(letter, records.tobytes()) for letter, records in arrays if len(records)]
    for frame in part.frames:
        times_us = frame.t_us, frame.exposure_begin_us, frame.exposure_end_us
        head = json.dumps([*times_us, frame.pixels.dtype.str, frame.pixels.shape, frame.origin])
        pieces.append((b"F", head.encode() + b"\n" + frame.pixels.tobytes()))
    last = len(pieces) - 1
    return [
        data
        for k, (letter, payload) in enumerate(pieces)
        for data in _message(letter if k == last else letter.lower(), payload)
    ]


def encoded_restart(unix_us: int) -> list[bytes]:
    """Return the message of a restart."""
    return _message(b"R", struct.pack("<q", unix_us))


def encoded_reached(t_us: int) -> list[bytes]:
    """Return the message of a time that was reached."""
    return _message(b"T", struct.pack("<q", t_us))


def values_of(facts: Facts) -> dict[str, Any]:
    """Return facts as values of JSON."""
    return vars(facts) | {"streams": sorted(facts.streams)}


def encoded_facts(facts: Facts) -> list[bytes]:
    """Return the message of facts."""
    return _message(b"H", json.dumps(values_of(facts)).encode())


def encoded_end(**values: Any) -> list[bytes]:
    """Return the message that ends a stream."""
    return _message(b"Z", json.dumps(values).encode())


def facts_of(values: dict[str, Any]) -> Facts:
    """Return the facts of `values_of`, or of an H message."""
    size = values["size"] and (int(values["size"][0]), int(values["size"][1]))
    fields = {field.name: values[field.name] for field in dataclasses.fields(Facts)}
    sets = {"streams": frozenset(values["streams"]), "remarks": tuple(values["remarks"])}
    return Facts(**fields | {"size": size} | sets)


def _message(letter: bytes, data: bytes) -> list[bytes]:
    return [_HEAD.pack(letter, len(data)), data]


class PipeReader:
    """Parser of the bytes of a pipe, which joins messages to parts."""

    def __init__(self) -> None:
        self._data = bytearray()
        self._part = Part()

    def feed(self, data: bytes) -> Iterator[Part | Restart | Reached | dict[str, Any]]:
        """Yield the values that are complete with the next bytes; raises ValueError for an invalid message."""
        self._data += data
        start = 0
        while len(self._data) - start >= _HEAD.size:
            letter, size = _HEAD.unpack_from(self._data, start)
            if size > _MOST_BYTES:
                raise ValueError(_FOREIGN)
            end = start + _HEAD.size + size
            if end > len(self._data):
                break
            payload = bytes(memoryview(self._data)[start + _HEAD.size : end])
            start = end
            if letter in b"HRTZ":
                yield _decoded(letter, payload)
                continue
            self._part = _with(self._part, letter.upper(), payload)
            if letter.isupper():
                yield self._part
                self._part = Part()
        del self._data[:start]


def _decoded(letter: bytes, data: bytes) -> Restart | Reached | dict[str, Any]:
    if letter in b"RT":
        return (Restart if letter == b"R" else Reached)(struct.unpack("<q", data)[0])
    values: dict[str, Any] = json.loads(data)
    return {"kind": letter.decode(), **values}


def _with(part: Part, letter: bytes, data: bytes) -> Part:
    """Return the part with the data of a message."""
    if letter == b"E":
        return dataclasses.replace(part, events=np.frombuffer(data, EVENT))
    if letter == b"X":
        return dataclasses.replace(part, edges=np.frombuffer(data, EDGE))
    if letter == b"I":
        return dataclasses.replace(part, imu=np.frombuffer(data, IMU))
    if letter == b"F":
        return dataclasses.replace(part, frames=(*part.frames, _frame(data)))
    raise ValueError(_FOREIGN)


def _frame(data: bytes) -> Frame:
    head, _, pixels = data.partition(b"\n")
    t_us, begin_us, end_us, dtype, shape, (column, row) = json.loads(head)
    return Frame(t_us, begin_us, end_us, np.frombuffer(pixels, dtype).reshape(shape), (column, row))


def wrong_event(events: Events, before_us: int, size: tuple[int, int]) -> tuple[int, str] | None:
    """Return index and fault of the first of events (n,) EVENT that goes back in time or lies outside; None for none.

    `before_us` is the time of the event before them, `size` that of the sensor.
    """
    before = np.append(np.uint64(before_us), events["t"][:-1])[: len(events)]
    is_back = events["t"] < before
    is_wrong = is_back | (events["x"] >= size[0]) | (events["y"] >= size[1])
    if not is_wrong.any():
        return None
    k = int(is_wrong.argmax())
    t, x, y, _ = events[k].item()
    if is_back[k]:
        return k, f"goes back in time, from {before[k]} to {t} us"
    return k, f"is at ({x}, {y}), outside a sensor of {size[0]} x {size[1]} pixels"
