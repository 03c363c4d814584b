"""AEDAT 4.0 files by faery: events, triggers, IMU samples and frames are written and read; damaged files are recovered.

Frames are written with 8 bits, as readers expect them, and grey. faery 0.7.1 writes only frames that it has read
itself, so each frame is first written to a small file, see `_Frames`.

Times in a file are Unix microseconds, and `tsOffset` is that of t = 0. Readers use the names `events`, `frames`, `imu`
and `triggers`. During writing, the header states that there is no table of packets. So a file that was never closed is
read up to its last whole packet.

All readers refuse a finished AEDAT 4.0 file that was cut, because its header refers to a table that is missing.
`recover_aedat4` makes a copy whose header states that there is none, and which ends with the last whole packet.
`RawEvents` recovers the raw events of an `.npz` record.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, BinaryIO

import numpy as np
from faery.extension import aedat

from firmware_protocol.events import EDGE, EVENT, EdgeKind, Edges
from firmware_protocol.recordings.aedat4 import MAGIC, Aedat4Head, aedat4_picture, packet_at
from transports.recording.part import IMU, Facts, Frame, Part, RecordingError

_TRIGGER = np.dtype([("t", "<u8"), ("source", "u1")])
_SOURCES = {EdgeKind.RISING: 1, EdgeKind.FALLING: 2, EdgeKind.PULSE: 3}
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
        self._folder = TemporaryDirectory(prefix="evstim-frames-")
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
    nodes = [_node(facts, f"{top}{_NUMBERS[one]}/", [*row, compression]) for one, *row in _STREAMS if one in streams]
    return aedat.DescriptionNode("outInfo", top, {}, nodes)


def _node(facts: Facts, path: str, row: list[str]) -> Any:
    name, kind, told, compression = row
    about = {
        "compression": compression, "originalModuleName": "capture", "originalOutputName": name,
        "typeDescription": told, "typeIdentifier": kind,
    }  # fmt: skip
    info = {"source": _text(facts.camera), "tsOffset": aedat.DescriptionAttribute("long", facts.unix_us)}
    if facts.size is not None and kind in ("EVTS", "FRME"):
        info |= {f"size{axis}": aedat.DescriptionAttribute("int", n) for axis, n in zip("XY", facts.size, strict=True)}
    own = {key: _text(value) for key, value in about.items()}
    inner = [aedat.DescriptionNode("info", f"{path}info/", info, [])]
    return aedat.DescriptionNode(path.split("/")[-2], path, own, inner)


def _text(value: str) -> Any:
    return aedat.DescriptionAttribute("string", value)


def _triggers(edges: Edges) -> Any:
    triggers = np.zeros(len(edges), _TRIGGER)
    triggers["t"] = edges["t"]
    for kind, source in _SOURCES.items():
        triggers["source"][edges["kind"] == kind] = source
    return triggers


class Aedat4Reader:
    """Reader of the first event stream and its companions; for a child process, see `guarded`."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self._decoder = aedat.Decoder(path)
        tracks = {track.id: track for track in self._decoder.tracks()}
        events = next((track for track in tracks.values() if track.data_type == "events"), None)
        if events is None:
            raise RecordingError("it holds no stream of events")
        self._events = events.id
        kinds = {"imus": "imu", "triggers": "edges", "frame": "frames"}
        streams = frozenset(kinds[track.data_type] for track in tracks.values() if track.data_type in kinds)
        info = _info(self._decoder.description(), events.id)
        self.facts = Facts(events.dimensions or size, str(info.get("source", "aedat4")), _start(info), streams)
        self.other_streams = len(tracks) - 1 - len(streams)

    def parts(self) -> Iterator[Part]:
        """Yield packets; raises at the first damaged one, after all packets before it."""
        start_us = np.uint64(self.facts.unix_us)
        with self._decoder as packets:
            for track, packet in packets:
                if track.data_type == "frame":
                    yield Part(frames=(_frame(packet, int(start_us)),))
                    continue
                packet = packet.copy()
                packet["t"] -= start_us
                if track.id == self._events:
                    yield Part(packet.view(EVENT))
                elif track.data_type == "triggers":
                    yield Part(edges=_edges(packet))
                elif track.data_type == "imus":
                    yield Part(imu=packet.view(IMU))


def _info(description: Any, stream: int) -> Mapping[str, Any]:
    for top in description:
        for node in top.nodes:
            if node.name == str(stream):
                return {key: one.value for inner in node.nodes for key, one in inner.attributes.items()}
    return {}


def _start(info: Mapping[str, Any]) -> int:
    offset = info.get("tsOffset", 0)
    return offset if isinstance(offset, int) and 0 <= offset < 1 << 62 else 0


def _frame(frame: Any, start_us: int) -> Frame:
    times = frame.t - start_us, frame.exposure_start_t - start_us, frame.exposure_end_t - start_us
    return Frame(*times, frame.pixels, (frame.offset_x, frame.offset_y))


def _edges(triggers: Any) -> Edges:
    """Return the external triggers; resets, generators and marks of frames are omitted."""
    kinds = {source: kind for kind, source in _SOURCES.items()}
    known = triggers[np.isin(triggers["source"], list(kinds))]
    edges = np.zeros(len(known), EDGE)
    edges["t"] = known["t"]
    for source, kind in kinds.items():
        edges["kind"][known["source"] == source] = kind
    return edges


_MOST_HEADER = 1 << 24
_PIECE_BYTES = 1 << 20


@dataclass(frozen=True)
class Saved:
    """Result of a recovery: number of packets, their bytes, and bytes omitted at the end."""

    packets: int
    kept_bytes: int
    left_bytes: int


def recover_aedat4(source: Path, target: Path) -> Saved:
    """Copy the whole packets of an AEDAT 4.0 file; raises RecordingError if the header is damaged, or OSError."""
    with source.open("rb") as file:
        try:
            head = Aedat4Head(file.read(len(MAGIC) + 4 + _MOST_HEADER))
        except ValueError as error:
            raise RecordingError(str(error)) from error
        size = source.stat().st_size
        end = head.table_at if head.packets_at <= head.table_at <= size else size
        file.seek(head.packets_at)
        with target.open("wb") as copy:
            copy.write(head.unfinished())
            packets, kept = _copied(file, copy, end - head.packets_at)
    return Saved(packets, kept, end - head.packets_at - kept)


def _copied(file: BinaryIO, copy: BinaryIO, left: int) -> tuple[int, int]:
    packets = kept = 0
    while size := packet_at(head := file.read(8), left - kept):
        copy.write(head)
        for start in range(8, size, _PIECE_BYTES):
            copy.write(file.read(min(_PIECE_BYTES, size - start)))
        packets += 1
        kept += size
    return packets, kept


class RawEvents:
    """Reader of the `.part` file of an `.npz` record whose run was killed, from the last clock restart on."""

    def __init__(self, path: Path, size: tuple[int, int] | None) -> None:
        self.facts = Facts(size, "record", streams=frozenset())
        self._path = path

    def parts(self) -> Iterator[Part]:
        """Yield the whole events; if time goes back, the clock was restarted, and earlier events are omitted."""
        count = self._path.stat().st_size // EVENT.itemsize
        if not count:
            return
        events = np.memmap(self._path, EVENT, "r", shape=(count,))
        step = _PIECE_BYTES // EVENT.itemsize
        back = [
            int(k) + start + 1
            for start in range(0, count, step)
            for k in np.flatnonzero(np.diff(events["t"][start : start + step + 1].astype(np.int64)) < 0)
        ]
        for start in range(back[-1] if back else 0, count, step):
            yield Part(np.array(events[start : start + step]))
