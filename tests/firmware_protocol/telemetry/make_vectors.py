"""Writes the golden vectors. The tests check that it would write the same again.

Run it as `python tests/firmware_protocol/telemetry/make_vectors.py`, with the project on the path.

vectors/blocks.json    name, hex, near_us, header fields, and what the block decodes to: events (t, x, y, p) or edges
vectors/refused.json   name, hex, why: bytes that a decoder must refuse as a whole
"""

import json
from pathlib import Path

import numpy as np
from block_strategies import events_of, stream

from firmware_protocol.events import EDGE, empty_events
from firmware_protocol.telemetry.layout import crc8
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

FOLDER = Path(__file__).parent / "vectors"
DAVIS = (346, 260)
THREE = events_of((1_000_000, 10, 5, 1), (1_000_000, 12, 5, 0), (1_000_003, 0, 0, 1))


def block(name, data, near_us=0):
    decoded = decode_block(data, near_us)
    vector = {
        "name": name,
        "hex": data.hex(),
        "near_us": near_us,
        "mode": decoded.header.mode.name,
        "tick_us": decoded.header.tick_us,
        "size": list(decoded.header.size),
        "dropped": decoded.header.dropped,
    }
    if len(decoded.edges):
        return {**vector, "edges": [list(row) for row in decoded.edges.tolist()]}
    return {**vector, "events": [[t, x, y, int(on)] for t, x, y, on in decoded.events.tolist()]}


def encoded(name, events, size=DAVIS, dropped=0, near_us=0, **settings):
    data, taken = BlockEncoder(size, BlockSettings(**settings)).encode(events, dropped)
    assert taken == len(events), name
    return block(name, data, near_us)


def burst(*, uniform):
    """Two ticks of a flash over part of the picture: solid runs, runs with gaps, single events."""
    rng = np.random.default_rng(11)
    there = np.concatenate([np.arange(100, 160), 400 + np.flatnonzero(rng.random(60) < 0.6), [20_000, 40_000, 40_001]])
    events = empty_events(2 * len(there))
    both = np.concatenate([there, there + 346])
    events["t"][len(there) :] = 1
    events["x"], events["y"] = both % 346, both // 346
    events["on"] = 1 if uniform else rng.integers(0, 2, len(both))
    events["on"][:60] = 1
    return events


def all_off(events):
    events["on"] = False
    return events


def far_apart():
    near = [(1000, x, 3, x % 3 == 0) for x in range(60)]
    return events_of(*near, (1000, 300, 200, 1), (1_000_000, 0, 0, 1), (2_000_000_000, 345, 259, 0))


def blocks():
    edges = np.array([(2**33 + 5, 2, 0, 1), (2**33 + 5, 3, 1, 65535), (2**33 + 2**31 + 4, 4, 255, 240)], EDGE)
    repeated = events_of(*[(7, 345, 259, i % 2) for i in range(9)], (7 + 2**20, 345, 259, 1))
    wrap = events_of((2**32 - 3, 1, 1, 1), (2**32 - 1, 5, 2, 0), (2**32 + 4, 300, 250, 1))
    return [
        encoded("page: three events, ROWS", THREE, mode="rows"),
        encoded("page: three events, FLAT", THREE, mode="flat"),
        block("page: a small BITMAP", bytes.fromhex("12 30 00 0C 00 00 00 00 00 00 00 70 03 3D 01 02 54 2C B8")),
        block("no events, only dropped", BlockEncoder(DAVIS).encode(empty_events(), 70_000)[0]),
        block("edges", BlockEncoder(DAVIS).encode_edges(edges, 2), 2**33),
        block("an escape to the same pixel", by_hand(1, 2, f"00000000 01 001 {ESCAPE} {0:031b} 01 001")),
        block("spans up to the end of the array", by_hand(2, 4, "00000000 00000000 11 101 110 1 0")),
        encoded("one event, ROWS", THREE[:1], mode="rows"),
        encoded("one event, BITMAP", THREE[1:2], mode="bitmap", dropped=3),
        *(encoded(f"the low 32 bits of time wrap, {mode}", wrap, mode=mode, near_us=2**32) for mode in MODES),
        *(encoded(f"one pixel ten times, {mode}", repeated, mode=mode) for mode in ("rows", "bitmap")),
        *(encoded(f"escapes, {mode}", far_apart(), mode=mode) for mode in ("rows", "bitmap")),
        *(encoded(f"a burst, {mode}", burst(uniform=False), mode=mode) for mode in ("rows", "bitmap")),
        encoded("a burst of ON events, BITMAP", burst(uniform=True), mode="bitmap"),
        encoded("OFF events, ROWS", all_off(stream(DAVIS, 40, 500, 3)), mode="rows"),
        *(encoded(f"sparse, {t} us", stream(DAVIS, 120, 400, 1, 987_654), tick_us=t) for t in (1, 10, 100, 1000)),
        *(encoded(f"{w} x {h}", stream((w, h), 60, 300, 2), size=(w, h)) for w, h in SIZES),
    ]


ESCAPE = "1" * 16
MODES = ("flat", "rows", "bitmap")
SIZES = ((1, 1), (7, 3), (1, 4096), (640, 480), (1280, 720), (4096, 4096))


def changed(data, **bytes_at):
    """Set bytes (b0=..., b14=...) and make the header's CRC right again."""
    data = bytearray(data)
    for name, value in bytes_at.items():
        data[int(name[1:])] = value
    data[13] = crc8(data[:13])
    return bytes(data)


def by_hand(mode, count, bits):
    """A block of ON events of a sensor of 8 x 4 with a payload given as bits: rows have 2, columns 3."""
    bits = bits.replace(" ", "")
    bits += "0" * (-len(bits) % 8)
    header = bytes([0x10 | mode, 0x30, 0, count, 0, 0, 0, 0, 0, 0, 0, 0x70, 0x03, 0])
    return changed(header + bytes(int(bits[i : i + 8], 2) for i in range(0, len(bits), 8)))


def refused():
    flat, rows, bitmap = (BlockEncoder(DAVIS, BlockSettings(mode=mode)).encode(THREE)[0] for mode in MODES)
    solid = bytes.fromhex("12 30 00 0C 00 00 00 00 00 00 00 70 03 3D 01 02 54 2C B8")
    edge = BlockEncoder(DAVIS).encode_edges(np.array([(5, 2, 0, 1), (9, 3, 0, 2)], EDGE))
    cases = [
        ("nothing at all", b"", 1),
        ("half a header", rows[:9], 1),
        ("a wrong CRC-8", rows[:13] + bytes([rows[13] ^ 1]) + rows[14:], 1),
        ("version 2", changed(rows, b0=0x21), 1),
        ("mode 4", changed(rows, b0=0x14), 1),
        ("a reserved bit", changed(rows, b1=0x01), 1),
        ("polarity 1", changed(rows, b1=0x10), 1),
        ("FLAT with one polarity", changed(flat, b1=0x20), 1),
        ("EDGE with a tick of 10 us", changed(edge, b1=0x40), 1),
        ("ROWS of nothing", changed(rows, b3=0), 2),
        ("EDGE of nothing", changed(edge[:14], b3=0), 2),
        ("FLAT of nothing, with a payload", changed(flat, b3=0), 3),
        ("ROWS, a byte short", rows[:-1], 3),
        ("ROWS, a byte more", rows + b"\0", 3),
        ("ROWS, padding", rows[:-1] + bytes([rows[-1] | 1]), 3),
        ("ROWS, one event more than there is", changed(rows, b3=4), 3),
        ("ROWS, one event less", changed(rows, b3=2), 3),
        ("ROWS, 65535 events", changed(rows, b2=255, b3=255), 3),
        ("FLAT, a byte short", flat[:-1], 3),
        ("FLAT, a word more", flat + flat[-4:], 3),
        ("BITMAP, a byte short", bitmap[:-1], 3),
        ("EDGE, a byte more", edge + b"\0", 3),
        ("k = 28", changed(rows, b14=28), 4),
        ("bits above k", changed(rows, b14=rows[14] | 0x20), 4),
        ("kl = 28", changed(solid, b15=28), 4),
        ("a length that is an escape", changed(solid, b3=1)[:14] + bytes([1, 0]) + bytes([0x57, 0xFF, 0xF8]), 4),
        ("ROWS, k = 28 that is not used", by_hand(1, 1, "00011100 01 001"), 4),
        ("BITMAP, ks = 28 that is not used", by_hand(2, 1, "00011100 00000000 01 001 0"), 4),
        ("BITMAP, kl = 28 with a length of 1", by_hand(2, 1, "00000000 00011100 01 001 0" + "0" * 28), 4),
        ("an escape to a row outside", changed(by_hand(1, 2, f"00000000 01 001 {ESCAPE} {1:031b} 11 000"), b12=2), 5),
        ("an escape that goes back in its tick", by_hand(1, 2, f"00000000 01 001 {ESCAPE} {0:031b} 01 000"), 6),
        ("BITMAP, an escape back", by_hand(2, 2, f"00000000 00000000 01 001 0 {ESCAPE} {0:031b} 00 111 0"), 6),
        ("a span that ends one past the array", by_hand(2, 3, "00000000 00000000 11 110 110 1"), 5),
        ("one column outside, of 7", changed(by_hand(1, 1, "00000000 00 111"), b11=0x60, b12=2), 5),
        ("one row outside, of 3", changed(by_hand(1, 1, "00000000 11 000"), b11=0x60, b12=2), 5),
        ("row 511", changed(rows, b15=0xFF, b16=rows[16] | 0x80), 5),
        ("a FLAT word outside the array", flat[:14] + bytes([0, 0, 0x16, 0xBD]) + flat[18:], 5),
        ("a span past the end of the array", changed(solid, b12=1), 5),
        ("a span of more than n events", changed(solid, b3=11), 5),
        ("FLAT does not start at 0", flat[:14] + b"\0\x08" + flat[16:], 6),
        ("FLAT goes back", flat[:14] + flat[18:22] + flat[14:18] + flat[22:], 6),
        ("an edge does not start at 0", edge[:17] + b"\1" + edge[18:], 6),
        ("edges go back", edge + b"\0\0\0\1\2\0\0\0", 3),
        ("edges go back in time", changed(edge + b"\0\0\0\1\2\0\0\0", b3=3), 6),
        ("an edge beyond 35 minutes", edge[:22] + b"\x80" + edge[23:], 6),
        ("an edge of kind 5", edge[:18] + b"\5" + edge[19:], 7),
        ("ROWS beyond 35 minutes", too_late(), 6),
    ]
    return [{"name": name, "hex": data.hex(), "why": why} for name, data, why in cases]


def too_late():
    """An event 2**31 - 1 ticks of 1 us late is in time; with ticks of 10 us it is not."""
    data, _ = BlockEncoder(DAVIS, BlockSettings(mode="rows")).encode(events_of((0, 1, 1, 1), (2**31 - 1, 1, 1, 1)))
    return changed(data, b1=0x40 | data[1])


def text_of(vectors):
    """One vector a line, so that a change shows what changed."""
    return "[\n" + ",\n".join(json.dumps(vector, separators=(",", ":")) for vector in vectors) + "\n]\n"


def files():
    return {"blocks.json": text_of(blocks()), "refused.json": text_of(refused())}


if __name__ == "__main__":
    for name, text in files().items():
        (FOLDER / name).write_text(text)
