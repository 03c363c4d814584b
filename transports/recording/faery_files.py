"""AEDAT 4.0, DAT, Event Stream and CSV files, written by faery.

DAT, Event Stream and CSV: times stay unchanged (no t0 is subtracted), while faery would begin each file at its first
event. Event Stream counts rows from the bottom, and faery's writer does not convert them.

AEDAT 4.0 holds events, triggers, IMU samples and frames. Frames are written with 8 bits, as readers expect them, and
grey. faery 0.7.1 writes only frames that it has read itself, so each frame is first written to a small file, see
`_Frames`. Times in a file are Unix microseconds, and `tsOffset` is that of t = 0. Readers use the names `events`,
`frames`, `imu` and `triggers`. During writing, the header states that there is no table of packets. So a file that was
never closed is read up to its last whole packet.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from faery.extension import aedat, csv, dat, es

from firmware_protocol.events import Edges, Events, make_events
from firmware_protocol.recordings.aedat4 import SOURCES, Aedat4Head, aedat4_picture
from firmware_protocol.recordings.part import Facts, Frame, Part
from transports.output_file import TemporaryFolder
from transports.recording.part import Writer

_COMMA = 44
_DAT_EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("payload", "u1")])


class _EventsWriter:
    """Writer of events only, with an encoder of faery that takes what `packet_of` makes of them."""

    def __init__(self, encoder: Any, packet_of: Callable[[Events], Any] = np.asarray) -> None:
        self._encoder, self._packet_of = encoder, packet_of
        encoder.__enter__()

    def write(self, part: Part) -> None:
        """Append the events."""
        if len(part.events):
            self._encoder.write(self._packet_of(part.events))

    def close(self) -> None:
        """Finish the file."""
        self._encoder.__exit__(None, None, None)


def dat_writer(path: Path, facts: Facts) -> Writer:
    """Return a writer of DAT, version 2."""
    encoder = dat.Encoder(path, version="dat2", event_type="cd", zero_t0=False, dimensions=facts.size)
    return _EventsWriter(encoder, lambda events: events.view(_DAT_EVENT))


def es_writer(path: Path, facts: Facts) -> Writer:
    """Return a writer of Event Stream files, rows from the bottom."""
    top = (facts.size or (0, 0))[1] - 1
    encoder = es.Encoder(path, event_type="dvs", zero_t0=False, dimensions=facts.size)
    return _EventsWriter(encoder, lambda events: make_events(events["t"], events["x"], top - events["y"], events["on"]))


def csv_writer(path: Path, facts: Facts) -> Writer:
    """Return a writer of lines t,x,y,on after a line with the names and the size."""
    return _EventsWriter(
        csv.Encoder(path, separator=_COMMA, header=True, dimensions=facts.size, enforce_monotonic=True)
    )


_TRIGGER = np.dtype([("t", "<u8"), ("source", "u1")])
_NUMBERS = {"events": 0, "frames": 1, "imu": 2, "edges": 3}  # as cameras number them
_STREAMS = (
    ("events", "events", "EVTS", "Array of events (polarity ON/OFF)."),
    ("frames", "frames", "FRME", "Standard frame (8-bit image)."),
    ("imu", "imu", "IMUS", "Inertial Measurement Unit data samples."),
    ("edges", "triggers", "TRIG", "External triggers and special signals."),
)
_LZ4 = ("lz4", 1)


class Aedat4Writer:
    """Writer of events, and of the streams that `facts` names."""

    def __init__(self, path: Path, facts: Facts) -> None:
        self._streams = {"events", *facts.streams}
        self._start_us = np.uint64(facts.unix_us)
        self._encoder = aedat.Encoder(path, [_description(facts, self._streams)], _LZ4)
        self._encoder.__enter__()
        self._frames = _Frames(facts) if "frames" in self._streams else None

    def write(self, part: Part) -> None:
        """Append one packet of each stream that has data."""
        self._put("events", self._shifted(part.events))
        self._put("edges", self._shifted(_triggers(part.edges)))
        self._put("imu", self._shifted(part.imu))
        if self._frames is not None:
            for frame in part.frames:
                self._encoder.write(_NUMBERS["frames"], self._frames.of_faery(frame, int(self._start_us)))

    def _put(self, stream: str, packet: Any) -> None:
        if len(packet) and stream in self._streams:
            self._encoder.write(_NUMBERS[stream], packet)

    def _shifted(self, records: Any) -> Any:
        if not self._start_us or not len(records):
            return records
        shifted = records.view(f"V{records.dtype.itemsize}").copy().view(records.dtype)
        shifted["t"] += self._start_us
        return shifted

    def close(self) -> None:
        """Write the table of packets and its place in the header."""
        self._encoder.__exit__(None, None, None)
        if self._frames is not None:
            self._frames.close()


class _Frames:
    """Converter to frames of faery: writes a file with one frame, and lets faery read it."""

    def __init__(self, facts: Facts) -> None:
        self._folder = TemporaryFolder("frames")
        self._path = Path(self._folder.name) / "frame.aedat4"
        with aedat.Encoder(self._path, [_description(facts, {"frames"}, "NONE")], None):
            pass
        self._head = Aedat4Head(self._path.read_bytes()).unfinished()

    def of_faery(self, frame: Frame, start_us: int) -> Any:
        """Return a frame whose times are later by `start_us`; of more than 8 bits, 10 are used."""
        pixels = frame.pixels if frame.pixels.dtype == np.uint8 else (frame.pixels >> 2).astype(np.uint8)
        pixels = pixels if pixels.ndim == 2 else pixels.mean(axis=2).astype(np.uint8)
        t, begin, end = (t + start_us for t in (frame.t_us, frame.exposure_begin_us, frame.exposure_end_us))
        payload = aedat4_picture(t, begin, end, np.ascontiguousarray(pixels), frame.origin)
        packet = struct.pack("<ii", _NUMBERS["frames"], len(payload)) + payload
        self._path.write_bytes(self._head + packet)
        with aedat.Decoder(self._path) as packets:
            return next(iter(packets))[1]

    def close(self) -> None:
        """Remove the file."""
        self._folder.cleanup()


def _description(facts: Facts, streams: set[str], compression: str = "LZ4") -> Any:
    top = "/mainloop/Recorder/outInfo/"
    nodes = [
        _node(facts, f"{top}{_NUMBERS[stream]}/", [*row, compression]) for stream, *row in _STREAMS if stream in streams
    ]
    return aedat.DescriptionNode("outInfo", top, {}, nodes)


def _node(facts: Facts, path: str, row: list[str]) -> Any:
    name, kind, description, compression = row
    about = {
        "compression": compression, "originalModuleName": "capture", "originalOutputName": name,
        "typeDescription": description, "typeIdentifier": kind,
    }  # fmt: skip
    info = {"source": _text(facts.camera), "tsOffset": aedat.DescriptionAttribute("long", facts.unix_us)}
    if facts.size is not None and kind in ("EVTS", "FRME"):
        info |= {f"size{axis}": aedat.DescriptionAttribute("int", n) for axis, n in zip("XY", facts.size, strict=True)}
    attributes = {key: _text(value) for key, value in about.items()}
    inner = [aedat.DescriptionNode("info", f"{path}info/", info, [])]
    return aedat.DescriptionNode(path.split("/")[-2], path, attributes, inner)


def _text(value: str) -> Any:
    return aedat.DescriptionAttribute("string", value)


def _triggers(edges: Edges) -> Any:
    triggers = np.zeros(len(edges), _TRIGGER)
    triggers["t"] = edges["t"]
    for kind, source in SOURCES.items():
        triggers["source"][edges["kind"] == kind] = source
    return triggers
