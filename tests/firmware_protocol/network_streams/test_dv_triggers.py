"""Packets of triggers, walked as a FlatBuffer is, and LZ4 frames unpacked."""

import struct

import lz4.frame
import numpy as np
import pytest

from firmware_protocol.events import EDGE, EdgeKind, empty_events, make_edges
from firmware_protocol.network_streams.coders import DvTriggerCoder, StreamFacts


def field(data, table, number, form):
    """Return a field of a table, as "FlatBuffer Internals" of flatbuffers.dev says."""
    fields = table - struct.unpack_from("<i", data, table)[0]
    assert 4 + 2 * number < struct.unpack_from("<H", data, fields)[0]
    at = table + struct.unpack_from("<H", data, fields + 4 + 2 * number)[0]
    assert at % struct.calcsize(form) == 0
    return at, struct.unpack_from("<" + form, data, at)[0]


def walked(packet):
    """Return (us, kind) of each trigger; positions count from the length before the FlatBuffer, which aligns it."""
    stream, size, length = struct.unpack_from("<iiI", packet)
    assert (stream, size, length) == (0, len(packet) - 8, len(packet) - 12)
    data = packet[8:]
    assert data[8:12] == b"TRIG"
    root = 4 + struct.unpack_from("<I", data, 4)[0]
    at, distance = field(data, root, 0, "I")
    vector = at + distance
    triggers = []
    for k in range(struct.unpack_from("<I", data, vector)[0]):
        at = vector + 4 + 4 * k
        table = at + struct.unpack_from("<I", data, at)[0]
        triggers.append((field(data, table, 0, "q")[1], field(data, table, 1, "b")[1]))
    return triggers


@pytest.mark.parametrize("compression", ["none", "lz4"])
@pytest.mark.parametrize("count", [1, 2, 3, 4, 100])
def test_triggers_are_where_a_reader_of_flatbuffers_looks(count, compression):
    edges = make_edges(
        np.arange(count) * 3 + (1 << 40), np.resize([EdgeKind.RISING, EdgeKind.FALLING, EdgeKind.PULSE], count)
    )
    coder = DvTriggerCoder(StreamFacts((346, 260), "CAM", compression=compression))
    packet = bytes(coder.encode(empty_events(), edges))
    if compression == "lz4":
        body = lz4.frame.decompress(packet[8:])
        packet = struct.pack("<ii", 0, len(body)) + body
    assert walked(packet) == [((1 << 40) + 3 * k, 1 + k % 3) for k in range(count)]


def test_a_restart_of_the_clock_is_a_trigger_and_no_edges_are_nothing():
    coder = DvTriggerCoder(StreamFacts((346, 260), "CAM"))
    assert walked(coder.restart()) == [(0, 0)]
    assert coder.encode(empty_events(), np.zeros(0, EDGE)) == b""
