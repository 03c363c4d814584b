"""DAT and Event Stream: every stored time, both types of DAT, octets of a cut record, any octets."""

import struct
from contextlib import suppress

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import join_events
from firmware_protocol.recordings.event_files import DatDecoder, EventStreamDecoder

DAT = b"%% Data file\n%% Version %d\n%% Height 240\n%% Width 304\n"
STREAM = struct.pack("<12s4BHH", b"Event Stream", 2, 0, 0, 1, 304, 240)


def record(t, x, y, on):
    return struct.pack("<II", t, on << 28 | y << 14 | x)


def read(kind, data, piece=1 << 16):
    decoder = kind(data[:4096])
    parts = [decoder.decode(data[k : k + piece]) for k in range(decoder.start, len(data), piece)]
    return decoder, join_events(parts).tolist()


@pytest.mark.parametrize("kind", [0, 12])
@pytest.mark.parametrize("piece", [1, 13, 1 << 16])
def test_times_of_dat_are_those_that_are_stored(kind, piece):
    rows = [(4_000_000_000, 1, 1, True), (100, 303, 239, False), (200, 2, 0, True)]
    decoder, got = read(DatDecoder, DAT % 2 + bytes([kind, 8]) + b"".join(record(*row) for row in rows), piece)
    assert (got, decoder.size, decoder.rest) == (rows, (304, 240), b"")


def test_dat_of_version_1_has_other_bits_and_faery_writes_a_start():
    word = struct.pack("<II", 100, 1 << 17 | 200 << 9 | 300)
    assert read(DatDecoder, DAT % 1 + b"\x0c\x08" + word)[1] == [(100, 300, 200, True)]
    assert read(DatDecoder, DAT % 2 + b"% T0 5000\n\x0c\x08" + record(1, 2, 3, 0))[1] == [(5001, 2, 3, False)]


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (DAT % 2 + b"\x0e\x08", "type 14"), (DAT % 2 + b"\x0c\x10", "16 octets"), (DAT % 3 + b"\x0c\x08", "version 3"),
        (DAT % 2, "header is cut"), (b"% no end", "header is cut"),
    ],
)  # fmt: skip
def test_another_dat_is_refused_with_the_reason(data, words):
    with pytest.raises(ValueError, match=words):
        DatDecoder(data)


def test_event_stream_counts_rows_from_the_bottom_and_silence_in_octets():
    data = STREAM + b"\xff\xff\xfe" + struct.pack("<BHH", 3 << 1 | 1, 303, 0) + b"\xff" + struct.pack("<BHH", 0, 0, 239)
    for piece in (1, 4, 1000):
        decoder, got = read(EventStreamDecoder, data, piece)
        assert (got, decoder.size) == ([(257, 303, 239, True), (384, 0, 0, False)], (304, 240))
    with pytest.raises(ValueError, match="type 2"):
        EventStreamDecoder(STREAM[:15] + b"\x02" + STREAM[16:])


@pytest.mark.parametrize(("kind", "head"), [(DatDecoder, DAT % 2 + b"\x0c\x08"), (EventStreamDecoder, STREAM)])
def test_octets_of_a_cut_record_are_left(kind, head):
    octets = record(100, 1, 1, True) if kind is DatDecoder else struct.pack("<BHH", 200, 1, 1)
    decoder, got = read(kind, head + octets + octets[:3])
    assert (len(got), decoder.rest) == (1, octets[:3])


@given(st.binary(max_size=400), st.integers(1, 50))
def test_any_octets_are_events_or_the_rest(octets, piece):
    for kind, head in ((DatDecoder, DAT % 2 + b"\x0c\x08"), (EventStreamDecoder, STREAM)):
        _, got = read(kind, head + octets, piece)
        assert got == read(kind, head + octets)[1]
        assert len(got) <= len(octets) // 5
        for start in (octets, head[: len(octets)] + octets):
            with suppress(ValueError):
                kind(start)
    words = np.frombuffer(octets[: len(octets) & ~7], "<u4").reshape(-1, 2)
    assert [event[0] for event in read(DatDecoder, DAT % 2 + b"\x0c\x08" + octets)[1]] == words[:, 0].tolist()
