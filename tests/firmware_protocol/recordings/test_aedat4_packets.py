"""Packets of AEDAT 4.0: stored times, also those that go back, and any damage of a packet is refused in words."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EdgeKind
from firmware_protocol.recordings.aedat4 import MAGIC, Aedat4Decoder, Aedat4Head, aedat4_picture
from firmware_protocol.recordings.part import Part

EVENT4 = struct.Struct("<qhh?3x")
XML = b"""<dv version="2.0"><node name="outInfo" path="/"><node name="0" path="/"><attr key="typeIdentifier"
type="string">EVTS</attr><node name="info" path="/"><attr key="sizeX" type="int">64</attr><attr key="sizeY"
type="int">48</attr><attr key="source" type="string">A</attr><attr key="tsOffset" type="long">1000</attr></node></node>
<node name="1" path="/"><attr key="typeIdentifier" type="string">FRME</attr></node>
<node name="2" path="/"><attr key="typeIdentifier" type="string">IMUS</attr></node>
<node name="3" path="/"><attr key="typeIdentifier" type="string">TRIG</attr></node>
<node name="4" path="/"><attr key="typeIdentifier" type="string">EVTS</attr></node></node></dv>"""


def head(xml=XML):
    body = struct.pack("<I4s6xHHHHHiiIq4xI", 24, b"IOHE", 10, 24, 4, 12, 8, 10, 0, 16, -1, len(xml)) + xml
    return Aedat4Head(MAGIC + struct.pack("<I", len(body)) + body)


def events_packet(rows):
    body = struct.pack("<I4s2xHHHiII", 16, b"EVTS", 6, 8, 4, 6, 4, len(rows)) + b"".join(EVENT4.pack(*r) for r in rows)
    return struct.pack("<I", len(body)) + body


def triggers_packet(rows):
    """One table for each row: its layout, then offset to it, source, time."""
    tables = [struct.pack("<HHHH", 8, 16, 8, 4) + struct.pack("<iBxxxq", 8, source, t) for t, source in rows]
    start = 28 + 4 + 4 * len(rows)
    offsets = [start + 24 * k + 8 - (28 + 4 + 4 * k) for k in range(len(rows))]
    body = struct.pack("<I4s2xHHHiI", 16, b"TRIG", 6, 8, 4, 6, 4) + struct.pack("<I", len(rows))
    body += struct.pack(f"<{len(rows)}I", *offsets) + b"".join(tables)
    return struct.pack("<I", len(body)) + body


ROWS = [(1100, 1, 1, True), (1300, 63, 47, False), (1200, 2, 2, True)]


def test_times_that_go_back_are_kept_and_other_cameras_left_out():
    decoder = Aedat4Decoder(head())
    assert (decoder.info["source"], decoder.start_us, decoder.events) == ("A", 1000, 0)
    assert decoder.decode(0, events_packet(ROWS)).events.tolist() == [(t - 1000, x, y, on) for t, x, y, on in ROWS]
    assert len(decoder.decode(4, events_packet(ROWS)).events) == 0
    edges = decoder.decode(3, triggers_packet([(1500, 1), (1400, 2), (1450, 6)])).edges
    assert edges.tolist() == [(500, EdgeKind.RISING, 0, 0), (400, EdgeKind.FALLING, 0, 0)]
    picture = np.arange(12, dtype=np.uint8).reshape(3, 4)
    (frame,) = decoder.decode(1, aedat4_picture(2000, 1900, 1950, picture, (5, 6))).frames
    assert (frame.t_us, frame.exposure_begin_us, frame.exposure_end_us, frame.origin) == (1000, 900, 950, (5, 6))
    np.testing.assert_array_equal(frame.pixels, picture)
    assert decoder.damage == ""


@pytest.mark.parametrize("t_us", [999, 0, -1, -(2**63)])
def test_a_time_before_zero_ends_the_packet(t_us):
    for stream, packet in ((0, events_packet([ROWS[0], (t_us, 1, 1, True), ROWS[1]])),
                           (3, triggers_packet([(1500, 1), (t_us, 2), (1600, 1)]))):  # fmt: skip
        decoder = Aedat4Decoder(head())
        part = decoder.decode(stream, packet)
        assert len(part.events) + len(part.edges) == 1
        assert decoder.damage == f"it is damaged: a record has the time {t_us - 1000} us"


@pytest.mark.parametrize("xml", [b"", b"<dv", b"<dv/>", XML.replace(b"EVTS", b"POSE"), XML.replace(b'"3"', b'"x"')])
def test_a_description_without_events_is_refused(xml):
    with pytest.raises(ValueError, match=r"\w"):
        Aedat4Decoder(head(xml))


PACKETS = [events_packet(ROWS), aedat4_picture(2000, 1900, 1950, np.zeros((3, 4), np.uint8)),
           b"\0\0\0\0\x0c\0\0\0IMUS", triggers_packet([(1500, 1), (1400, 2)])]  # fmt: skip


@given(st.integers(0, 5), st.data())
def test_any_packet_is_read_or_refused(stream, data):
    whole = PACKETS[min(stream, 3)]
    packet = bytearray(whole[: data.draw(st.integers(0, len(whole)))])
    for _ in range(data.draw(st.integers(0, 4)) if packet else 0):
        packet[data.draw(st.integers(0, len(packet) - 1))] = data.draw(st.integers(0, 255))
    try:
        part = Aedat4Decoder(head()).decode(stream, bytes(packet))
    except ValueError:
        return
    assert isinstance(part, Part)
    assert part.edges.dtype == EDGE
