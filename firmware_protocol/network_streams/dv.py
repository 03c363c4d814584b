"""The streams of dv-processing network servers: events or triggers as packets of AEDAT 4.0, little-endian.

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
from typing import ClassVar
from xml.sax.saxutils import escape

import numpy as np
import numpy.typing as npt

from firmware_protocol.events import EdgeKind, Edges, Events
from firmware_protocol.network_streams.coders import ConnectionCoder, StreamFacts

__all__ = ["DV_EVENT", "DvCoder", "DvTriggerCoder"]

DV_EVENT = np.dtype([("t", "<i8"), ("x", "<i2"), ("y", "<i2"), ("on", "u1"), ("zero", "V3")])
"""The event of AEDAT 4.0, 16 bytes."""

_STREAM = 0
_COMPRESSIONS = {"none": 0, "lz4": 1}
_KINDS = {EdgeKind.RISING: 1, EdgeKind.FALLING: 2, EdgeKind.PULSE: 3}
_RESET = 0
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
    """Codes one stream."""

    limit_px: ClassVar[tuple[int, int]] = (1 << 15, 1 << 15)
    stream: ClassVar[tuple[str, str]]
    """Kind of its packets, and the stream's name."""

    def __init__(self, facts: StreamFacts) -> None:
        super().__init__(facts)
        compression = _COMPRESSIONS[facts.compression]
        self._greeting = _size_prefixed(_description(facts, *self.stream), compression)
        self._compress = bool(compression)

    @property
    def greeting(self) -> bytes:
        """The description of the stream."""
        return self._greeting

    def _sent(self, packet: bytearray) -> bytearray:
        """Return a packet as it is sent."""
        if not self._compress:
            return packet
        import lz4.frame

        frame = lz4.frame.compress(memoryview(packet)[_PACKET.size :])
        return bytearray(_PACKET.pack(_STREAM, len(frame)) + frame)


class DvCoder(_DvCoder):
    """Codes events for `dv_processing.io.NetworkReader` and the DV viewer."""

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
    """Codes edges on the camera's external input, and restarts of its clock, for the same clients."""

    stream: ClassVar[tuple[str, str]] = ("TRIG", "triggers")
    has_edges = True

    def encode(self, events: Events, edges: Edges) -> bytearray:
        """Return one packet of edges."""
        kinds = [_KINDS[EdgeKind(kind)] for kind in edges["kind"]]
        return self._packet(np.array(kinds, np.int8), edges["t"].astype(np.int64)) if kinds else bytearray()

    def restart(self) -> bytes:
        """Return the trigger of a restart."""
        return bytes(self._packet(np.array([_RESET], np.int8), np.zeros(1, np.int64)))

    def _packet(self, kinds: npt.NDArray[np.int8], t_us: npt.NDArray[np.int64]) -> bytearray:
        count = len(kinds)
        fields_at = _OFFSETS_AT + 4 * (count + count % 2)  # so that times are at multiples of eight
        tables_at = fields_at + len(_TRIGGER_FIELDS) + _TRIGGER.itemsize * np.arange(count)
        offsets = np.zeros(count + count % 2, "<u4")
        offsets[:count] = tables_at - _OFFSETS_AT - 4 * np.arange(count)
        tables = np.zeros(count, _TRIGGER)
        tables["back"], tables["kind"], tables["t"] = tables_at - fields_at, kinds, t_us
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


def _size_prefixed(xml: bytes, compression: int) -> bytes:
    """Return the header: its length, then a table "IOHE" whose third field is a string."""
    head = _HEAD.pack(24, b"IOHE", 10, 24, 4, 12, 8, 10, compression, 16, -1, len(xml))
    body = head + xml + bytes(4 - len(xml) % 4)
    return struct.pack("<I", len(body)) + body
