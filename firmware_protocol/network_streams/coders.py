"""Coders of event streams: events and edges in, bytes or datagrams out, and the settings of streams of images.

A connection begins with a greeting, and from then on every client gets the same bytes. Datagrams have no beginning:
each is complete in itself.

cAER and libcaer: AEDAT 3.1 packets after a header of 20 bytes, little-endian.

    i64 0x1D378BC90B9A6658   i64 number   i8 version 1   i8 format, 0: uncompressed   i16 source

A connection begins with one such header, number 0, and continues with bare packets. A datagram has its own: the number
increases by one each time, and its bit 63 marks the first datagram of a packet; at most 1452 bytes follow.

Source: inivation docs, "AEDAT 3.1 network streaming"; libcaer, `network.h`.

jAER's UDP stream ("AEUnicast"): a sequence number, then addresses and times as in AEDAT 2.0, big-endian.

    i32 number (the first is 1)   (u32 address   i32 us) ...

jAER reports a gap in the numbers to its user and continues. docs/streams.md lists its settings for this stream.

Source: jAER, AEUnicastOutput.java, AEUnicastInput.java, AENetworkInterfaceConstants.java.

faery: datagrams of events only, without a number, little-endian.

    t64_x16_y16_on8      u64 us   u16 x   u16 y   u8 ON                         at most 100
    t32_x16_y15_on1      u32 us   u16 x   u16: bits 15..1 y, bit 0 ON           at most 100

Source: faery 0.7.1 as a sender and a receiver.

The streams of dv-processing network servers: events or triggers as packets of AEDAT 4.0, little-endian.

    once      u32 length   FlatBuffer "IOHE": XML that describes one stream
    packets   i32 stream   i32 size   u32 length   FlatBuffer "EVTS": vector of events, 16 bytes each
    event     i64 us   i16 x   i16 y   u8 ON   3 bytes of zero
    or        FlatBuffer "TRIG": vector of offsets of tables; table: i32 back to its offsets, i8 kind, i64 us

With compression, all bytes of a packet after its size are one LZ4 frame.

A FlatBuffer begins with the offset of its table; the table begins with the distance back to the offsets of its fields.
Both beginnings are constants here. A connection carries one stream: NetworkReader 2.0.4 reads each packet as one of
the stream that it opened, and fails if a connection has two. The client sends nothing.

Sources: dv-processing 2.0.4 as a reader; aedat 2.3.0, schemas of its source distribution; flatbuffers.dev, "FlatBuffer
Internals".
"""

from __future__ import annotations

import struct
from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal, NamedTuple
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt
from msgspec import Meta

from firmware_protocol.bounds import Share, check_bounds
from firmware_protocol.events import EVENT, EdgeKind, Edges, Events, empty_edges
from firmware_protocol.recordings.aedat import encode_aedat2, encode_aedat31

Channel = Literal["on", "off", "count", "first_us", "last_us", "level", "filtered"]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class PictureSettings:
    """Content of images of events, for the formats "event_image" and "display".

    Attributes
    ----------
    channels : of an event image, in this order; see docs/streams.md.
    filter_ms : time constant of the low pass for the channel "filtered" and for the display's light.
    on_colour, off_colour : red, green, blue, 0 to 255, of pixels of the display with more ON, or more OFF events.
    both_colour : colour of pixels with equal numbers of both.
    background : colour of pixels without an event, if no light is shown.
    light_share : share of the filtered level that is shown as grey, 0 (none) to 1.
    light_below_events : True if it is also added to pixels that have events.
    contrast : change of log light for one event, if the level is shown as grey.
    """

    channels: tuple[Channel, ...] = ("on", "off", "first_us", "last_us", "level")
    filter_ms: Annotated[float, Meta(ge=0.1, le=60_000)] = 100.0
    on_colour: Colour = (0, 255, 0)
    off_colour: Colour = (255, 0, 0)
    both_colour: Colour = (255, 255, 0)
    background: Colour = (32, 32, 32)
    light_share: Share = 0.0
    light_below_events: bool = False
    contrast: Annotated[float, Meta(ge=0.001, le=10)] = 0.25

    def __post_init__(self) -> None:
        if not self.channels or len(set(self.channels)) != len(self.channels):
            raise ValueError(f"channels must be one or more, each once, got {list(self.channels)}")
        check_bounds(self)
        for name in ("on_colour", "off_colour", "both_colour", "background"):
            if not all(0 <= value <= 255 for value in getattr(self, name)):
                raise ValueError(f"{name} must be red, green, blue from 0 to 255, got {list(getattr(self, name))}")

    @property
    def filter_us(self) -> float:
        """Time constant of the low pass, us."""
        return self.filter_ms * 1000

    @property
    def shows_light(self) -> bool:
        """True if the display shows grey behind the events."""
        return self.light_share > 0


@dataclass(frozen=True)
class StreamFacts:
    """Properties of the camera and the stream.

    Attributes
    ----------
    size : (width, height) of the sensor, pixels.
    camera : its name, such as "DAVIS346_00000001".
    frame_us : stream time of an image, if the stream is one of images.
    compression : "none" or "lz4", if the format has it.
    pictures : content of the images, if the stream is one of images.
    form : name of the format, for coders of several.
    repeat_us : period of repeated times, if a receiver may join at any word; see `network_streams.words`.
    """

    size: tuple[int, int]
    camera: str
    frame_us: int = 20_000
    compression: str = "none"
    pictures: PictureSettings = field(default_factory=PictureSettings)
    form: str = ""
    repeat_us: int = 0


class Datagram(NamedTuple):
    """One datagram, and the end of its events in the batch: those up to `end` have left with it."""

    data: bytes
    end: int


class ConnectionCoder(ABC):
    """Coder of a stream for a connection.

    Attributes
    ----------
    limit_px : most columns and rows of the format.
    greeting : bytes that a client gets first; empty if the format has no header.
    has_edges : True if it carries edges on the camera's external input.
    """

    limit_px: ClassVar[tuple[int, int]]
    has_edges: ClassVar[bool] = False
    greeting: bytes = b""

    def __init__(self, facts: StreamFacts) -> None:
        self.facts = facts

    @abstractmethod
    def encode(self, events: Events, edges: Edges) -> bytes | bytearray:
        """Return whole packets of events (n,) EVENT and edges (m,) EDGE, each sorted, in the camera's own time."""

    def advance(self, t_us: int) -> bytes:
        """Return the packets that are complete because there are no more events before `t_us`."""
        return b""

    def restart(self) -> bytes:
        """Return the report of a restart of the camera's clock; empty if the format has none."""
        return b""

    def finish(self) -> bytes:
        """Return the rest that the coder holds at the end."""
        return b""


class DatagramCoder(ABC):
    """Coder of a stream for datagrams; see `ConnectionCoder` for the attributes."""

    limit_px: ClassVar[tuple[int, int]]
    has_edges: ClassVar[bool] = False

    def __init__(self, facts: StreamFacts) -> None:
        self.facts = facts

    @abstractmethod
    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams of events (n,) EVENT and edges (m,) EDGE, each sorted, in the camera's own time."""

    def restart(self) -> Iterator[Datagram]:
        """Yield the report of a restart of the camera's clock."""
        yield from ()


MAGIC = 0x1D378BC90B9A6658
HEADER = struct.Struct("<QQbbh")
"""Magic, number, version, format, source."""
FIRST = 1 << 63
CHUNK_BYTES = 1452
_VERSION, _RAW, _SOURCE = 1, 0, 1
_PACKET_HEAD, _EVENT_BYTES = 28, 8
_RESET = 1  # of special events


def reset_packet() -> bytes:
    """Return a packet with the special event of a clock restart; without it readers drop all later events."""
    head = struct.pack("<hhiiiiii", 0, _SOURCE, _EVENT_BYTES, 4, 0, 1, 1, 1)
    return head + struct.pack("<Ii", _RESET << 1 | 1, 0x7FFFFFFF)


class CaerConnectionCoder(ConnectionCoder):
    """Coder of events and edges for a TCP client of cAER's kind."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    has_edges: ClassVar[bool] = True
    greeting = HEADER.pack(MAGIC, 0, _VERSION, _RAW, _SOURCE)  # the header, number 0

    def encode(self, events: Events, edges: Edges) -> bytes:
        """Return packets: edges first, then events."""
        return encode_aedat31(events, edges)

    def restart(self) -> bytes:
        """Return a packet with a time-stamp reset."""
        return reset_packet()


class CaerDatagramCoder(DatagramCoder):
    """Coder of events and edges for a UDP receiver of cAER's kind: a packet in pieces, one for each datagram."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    has_edges: ClassVar[bool] = True

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._number = 0

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield the pieces of the packets of edges, then of those of events."""
        for packet in _single(encode_aedat31(events[:0], edges)):
            yield from (Datagram(data, 0) for data, _ in self._pieces(packet))
        before = 0
        for packet in _single(encode_aedat31(events, empty_edges())):
            for data, at in self._pieces(packet):
                yield Datagram(data, before + (at - _PACKET_HEAD) // _EVENT_BYTES)
            before += (len(packet) - _PACKET_HEAD) // _EVENT_BYTES

    def restart(self) -> Iterator[Datagram]:
        """Yield a time-stamp reset."""
        yield from (Datagram(data, 0) for data, _ in self._pieces(reset_packet()))

    def _pieces(self, packet: bytes) -> Iterator[tuple[bytes, int]]:
        """Yield the datagrams of one packet, each with the end of its piece."""
        for start in range(0, len(packet), CHUNK_BYTES):
            piece = packet[start : start + CHUNK_BYTES]
            number = self._number | (FIRST if start == 0 else 0)
            self._number = (self._number + 1) % FIRST
            yield HEADER.pack(MAGIC, number, _VERSION, _RAW, _SOURCE) + piece, start + len(piece)


def _single(packets: bytes) -> Iterator[bytes]:
    """Yield one packet after another."""
    start = 0
    while start < len(packets):
        (number,) = struct.unpack_from("<i", packets, start + 20)
        end = start + _PACKET_HEAD + number * _EVENT_BYTES
        yield packets[start:end]
        start = end


RECORDS = 183
"""Records of a datagram: 1468 bytes, which no network of 1500 bytes splits."""

_NUMBER = struct.Struct(">i")
_RECORD_BYTES = 8
_LAST = (1 << 31) - 1


class JaerCoder(DatagramCoder):
    """Coder of events and edges for jAER."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 10, 1 << 9)
    has_edges: ClassVar[bool] = True

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        self._number = 1

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams; an edge precedes the events of its time."""
        records = encode_aedat2(events, self.facts.size, edges)
        ends = _events_before(events, edges)
        count = len(records) // _RECORD_BYTES
        for first in range(0, count, RECORDS):
            end = min(first + RECORDS, count)
            data = _NUMBER.pack(self._number) + records[first * _RECORD_BYTES : end * _RECORD_BYTES]
            self._number = self._number + 1 if self._number < _LAST else 1
            yield Datagram(data, end if ends is None else int(ends[end]))


def _events_before(events: Events, edges: Edges) -> np.ndarray | None:
    """Return the number of events among the first n records, (records + 1,); None if all are events."""
    if not len(edges):
        return None
    is_event = np.arange(len(edges) + len(events)) >= len(edges)
    order = np.argsort(np.concatenate((edges["t"], events["t"])), kind="stable")
    return np.concatenate(([0], np.cumsum(is_event[order])))


_SHORT = np.dtype([("t", "<u4"), ("x", "<u2"), ("y_on", "<u2")])
_FAERY_EVENTS = 100


class FaeryLongCoder(DatagramCoder):
    """Coder of events as faery's `t64_x16_y16_on8`, which is the event record of this project."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 16, 1 << 16)

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams of the events; edges are left out."""
        yield from cut(events.view(f"V{EVENT.itemsize}"), _FAERY_EVENTS)


class FaeryShortCoder(DatagramCoder):
    """Coder of events as faery's `t32_x16_y15_on1`: times wrap after 71 minutes."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 16, 1 << 15)

    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams of the events; edges are left out."""
        records = np.empty(len(events), _SHORT)
        records["t"] = events["t"] & np.uint64(0xFFFFFFFF)
        records["x"] = events["x"]
        records["y_on"] = (events["y"] << 1) | events["on"]
        yield from cut(records, _FAERY_EVENTS)


def cut(records: np.ndarray, events_at_most: int) -> Iterator[Datagram]:
    """Yield datagrams of at most so many of records (n,), one an event."""
    data, size = records.tobytes(), records.dtype.itemsize
    for first in range(0, len(records), events_at_most):
        end = min(first + events_at_most, len(records))
        yield Datagram(data[first * size : end * size], end)


DV_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("zero", "V3")])
"""The event of AEDAT 4.0, 16 bytes."""

_STREAM = 0
_COMPRESSIONS = {"none": 0, "lz4": 1}
_KINDS = {EdgeKind.RISING: 1, EdgeKind.FALLING: 2, EdgeKind.PULSE: 3}
_TRIGGER_RESET = 0
_PACKET = struct.Struct("<ii")
# root at 16, name, 2 bytes of zero; offsets of a table with one field: their size, the table's, the field's; the table:
# back to its offsets, and from its field to the vector, which begins with its length
_EVENTS = struct.Struct("<II4s2xHHHiII")
_EVENTS_AT = _PACKET.size + _EVENTS.size
_TRIGGER = np.dtype([("back", "<i4"), ("zero", "V3"), ("kind", "i1"), ("t", "<i8")])
_TRIGGER_FIELDS = struct.pack("<4H", 8, _TRIGGER.itemsize, 8, 7)  # sizes of both, offsets of time and kind
_OFFSETS_AT = 28  # in the FlatBuffer, of the first element of its vector
# the same with three fields: compression, offset of the string, offset of the table of packets (-1: none)
_HEAD = struct.Struct("<I4s6xHHHHHiiIq4xI")


class _DvCoder(ConnectionCoder):
    """Coder of one stream."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    stream: ClassVar[tuple[str, str]]
    """Kind of its packets, and the stream's name."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        compression = _COMPRESSIONS[facts.compression]
        xml = _description(facts, *self.stream)
        # The header is its length, then a table "IOHE" whose third field is the XML.
        head = _HEAD.pack(24, b"IOHE", 10, 24, 4, 12, 8, 10, compression, 16, -1, len(xml))
        body = head + xml + bytes(4 - len(xml) % 4)
        self.greeting = struct.pack("<I", len(body)) + body
        self._compress = bool(compression)

    def _sent(self, packet: bytearray) -> bytearray:
        """Return a packet as it is sent."""
        if not self._compress:
            return packet
        import lz4.frame

        frame = lz4.frame.compress(memoryview(packet)[_PACKET.size :])
        return bytearray(_PACKET.pack(_STREAM, len(frame)) + frame)


class DvCoder(_DvCoder):
    """Coder of events for `dv_processing.io.NetworkReader` and the DV viewer."""

    stream: ClassVar[tuple[str, str]] = ("EVTS", "events")

    def encode(self, events: Events, edges: Edges) -> bytearray:
        """Return one packet; edges are not part of a stream of events."""
        count = len(events)
        if not count:
            return bytearray()
        packet = bytearray(_EVENTS_AT + count * DV_EVENT.itemsize)
        size = len(packet) - _PACKET.size
        _PACKET.pack_into(packet, 0, _STREAM, size)
        _EVENTS.pack_into(packet, _PACKET.size, size - 4, 16, b"EVTS", 6, 8, 4, 6, 4, count)
        records = np.frombuffer(packet, DV_EVENT, count, _EVENTS_AT)
        for name in ("t", "x", "y", "on"):
            records[name] = events[name]
        return self._sent(packet)


class DvTriggerCoder(_DvCoder):
    """Coder of edges on the camera's external input, and restarts of its clock, for the same clients."""

    stream: ClassVar[tuple[str, str]] = ("TRIG", "triggers")
    has_edges = True

    def encode(self, events: Events, edges: Edges) -> bytearray:
        """Return one packet of edges."""
        kinds = [_KINDS[EdgeKind(kind)] for kind in edges["kind"]]
        return self._packet(np.array(kinds, np.int8), edges["t"].astype(np.int64)) if kinds else bytearray()

    def restart(self) -> bytes:
        """Return the trigger of a restart."""
        return bytes(self._packet(np.array([_TRIGGER_RESET], np.int8), np.zeros(1, np.int64)))

    def _packet(self, kinds: npt.NDArray[np.int8], t_us: npt.NDArray[np.int64]) -> bytearray:
        count = len(kinds)
        fields_at = _OFFSETS_AT + 4 * (count + count % 2)  # so that times are at multiples of eight
        tables_at = fields_at + len(_TRIGGER_FIELDS) + _TRIGGER.itemsize * np.arange(count)
        offsets = np.zeros(count + count % 2, "<u4")
        offsets[:count] = tables_at - _OFFSETS_AT - 4 * np.arange(count)
        tables = np.zeros(count, _TRIGGER)
        tables["back"] = tables_at - fields_at
        tables["kind"], tables["t"] = kinds, t_us
        body = offsets.tobytes() + _TRIGGER_FIELDS + tables.tobytes()
        size = _EVENTS.size + len(body)
        head = _EVENTS.pack(size - 4, 16, b"TRIG", 6, 8, 4, 6, 4, count)
        return self._sent(bytearray(_PACKET.pack(_STREAM, size) + head + body))


def _description(facts: StreamFacts, kind: str, name: str) -> bytes:
    """Return the XML that readers need: kind and source of the stream."""
    width, height = facts.size
    camera = escape(facts.camera)
    return (
        '<dv version="2.0"><node name="outInfo" path="/outInfo/"><node name="0" '
        'path="/outInfo/0/"><attr key="compression" type="string">'
        f"{facts.compression.upper()}</attr>"
        '<attr key="originalModuleName" type="string">capture</attr>'
        f'<attr key="originalOutputName" type="string">{name}</attr>'
        f'<attr key="typeIdentifier" type="string">{kind}</attr>'
        '<node name="info" path="/outInfo/0/info/">'
        f'<attr key="sizeX" type="int">{width}</attr><attr key="sizeY" type="int">{height}</attr>'
        f'<attr key="source" type="string">{camera}</attr></node></node></node></dv>'
    ).encode()
