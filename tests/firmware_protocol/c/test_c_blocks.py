"""Event blocks in C, written from docs/packets.md: golden vectors, and what the Python decoder says of any bytes."""

import json
import struct
from pathlib import Path

import numpy as np
import pytest
from block_strategies import TICKS, blocks_of, stream, streams
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE
from firmware_protocol.telemetry.layout import BlockError
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder, BlockSettings

VECTORS = Path(__file__).parent.parent / "telemetry/vectors"
GOOD = json.loads((VECTORS / "blocks.json").read_text())
BAD = json.loads((VECTORS / "refused.json").read_text())
MODES = ["smallest", "flat", "rows", "bitmap"]
SIZE = (346, 260)


def request(blocks, near_us=0):
    return b"".join(struct.pack("<QI", near_us, len(block)) + block for block in blocks)


def size_in(block):
    """The size that a header tells, so that the decoder is one for that camera."""
    if len(block) < 13:
        return SIZE
    return (block[10] << 4 | block[11] >> 4) + 1, ((block[11] & 15) << 8 | block[12]) + 1


def sealed(header):
    """Put the right CRC-8 behind 13 bytes."""
    crc = 0xFF
    for byte in header:
        crc ^= byte
        for _ in range(8):
            crc = (crc << 1 ^ 0x2F) & 0xFF if crc & 0x80 else crc << 1
    return header + bytes([crc ^ 0xFF])


def python_says(block, near_us=0):
    try:
        return decode_block(block, near_us)
    except BlockError:
        return None


def check(library, blocks, near_us=0, size=None):
    """Compare the library with the Python decoder on each block; returns how many are good."""
    decoded = [python_says(block, near_us) for block in blocks]
    good = [block for block in decoded if block is not None]
    reply = library("b", request(blocks, near_us), size=size or size_in(blocks[0]))
    assert np.array_equal(reply.events, np.concatenate([block.events for block in good] or [reply.events[:0]]))
    assert np.array_equal(reply.edges, np.concatenate([block.edges for block in good] or [reply.edges[:0]]))
    dropped = sum(block.header.dropped for block in good)
    counts = [len(good), len(blocks) - len(good), 0, len(reply.events), len(reply.edges), dropped]
    assert reply.counters == counts
    return len(good)


@pytest.mark.system
@pytest.mark.parametrize("vector", [*GOOD, *BAD], ids=lambda v: v["name"])
def test_golden_blocks_are_judged_as_by_python(library, vector):
    """`test_vectors` has the events, edges and counts of each."""
    assert check(library, [bytes.fromhex(vector["hex"])], vector.get("near_us", 0)) == (vector in GOOD)


def test_blocks_of_another_camera_are_counted_apart(library):
    data, _ = BlockEncoder((640, 480)).encode(stream((640, 480), 5, 100, 1))
    assert library("b", request([data]), size=SIZE).counters == [0, 0, 1, 0, 0, 0]


@given(streams(), st.sampled_from(TICKS), st.sampled_from(MODES), st.sampled_from([64, 1024]))
def test_encoded_events_come_back(library, drawn, tick_us, mode, max_bytes):
    size, events = drawn
    encoder = BlockEncoder(size, BlockSettings(tick_us, mode, max_events=100, max_bytes=max_bytes))
    for data, taken in blocks_of(encoder, events):
        assert check(library, [data], int(taken["t"][0]) + 2**30) == 1


EDGE_ROWS = st.tuples(st.integers(0, 2**20), st.sampled_from([2, 3, 4]), st.integers(0, 255))


@given(st.lists(EDGE_ROWS, min_size=1, max_size=9))
def test_edges_come_back(library, rows):
    edges = np.array([(t, kind, channel, t & 0xFFFF) for t, kind, channel in sorted(rows)], EDGE)
    assert check(library, [BlockEncoder(SIZE).encode_edges(edges, 3)]) == 1


@given(st.integers(0, 2**34), st.integers(0, 2**32 - 1))
def test_time_is_completed_alike(library, near_us, base):
    block = sealed(bytes([0x11, 0x30, 0, 1]) + base.to_bytes(4, "big") + bytes([0, 0, 0x15, 0x91, 3])) + bytes(4)
    assert check(library, [block], near_us) == 1


@given(st.sampled_from(GOOD), st.lists(st.tuples(st.integers(0, 2**16), st.integers(0, 7)), min_size=1, max_size=3))
def test_damaged_blocks_are_refused_alike(library, vector, flips):
    block = bytearray(bytes.fromhex(vector["hex"]))
    for at, bit in flips:
        block[at % len(block)] ^= 1 << bit
    check(library, [bytes(block), sealed(bytes(block[:13])) + bytes(block[14:])])


@pytest.mark.parametrize("mode", range(4))
@pytest.mark.parametrize("size", [SIZE, (1, 1), (4096, 4096), (7, 3)])
def test_random_payloads_are_judged_alike(library, mode, size):
    rng = np.random.default_rng(mode)
    w, h = size[0] - 1, size[1] - 1
    blocks = []
    for _ in range(400):
        n = int(rng.choice([1, 2, 5, 40, 65535]))
        codes = int(rng.choice([0, 0x40, 0xC0]) | rng.choice([0, 0x20, 0x30]))
        head = bytes([0x10 | mode, codes, n >> 8, n & 255]) + rng.bytes(6)
        head += bytes([w >> 4, (w & 15) << 4 | h >> 8, h & 255])
        # Mostly small numbers, so that many payloads go on for a while and some to the end.
        payload = (np.frombuffer(rng.bytes(80), np.uint8) & rng.choice([0, 3, 255])).astype(np.uint8).tobytes()
        blocks.append(sealed(head) + payload[: int(rng.integers(0, 80))])
    check(library, blocks, size=size)


def block_of(mode, size, bits, *, n=1, codes=0x30):
    """A block with a right header around a payload written as a string of 0 and 1."""
    w, h = size[0] - 1, size[1] - 1
    head = bytes([0x10 | mode, codes, n >> 8, n & 255, *bytes(6), w >> 4, (w & 15) << 4 | h >> 8, h & 255])
    return sealed(head) + bytes(int(bits[i : i + 8].ljust(8, "0"), 2) for i in range(0, len(bits), 8))


@pytest.mark.parametrize("codes", [0x30, 0xF0], ids=["1 us", "1 ms"])
@pytest.mark.parametrize("mode", [1, 2])
def test_a_block_spans_less_than_2_to_31_us_and_no_more(library, mode, codes):
    last = 2147483647 if codes == 0x30 else 2147483
    for steps, good in (([last], 1), ([last, 0], 1), ([last, 1], 0), ([1, last], 0)):
        # A sensor of one pixel: a step is a number of ticks, here a Rice code with k = 27; spans are one pixel long.
        coded = ["1" * (step >> 27) + "0" + f"{step & (1 << 27) - 1:027b}" for step in steps]
        bits = f"{27:08b}" + ("".join(coded) if mode == 1 else "00000000" + "0".join(["", *coded, ""]))
        assert check(library, [block_of(mode, (1, 1), bits, n=1 + len(steps), codes=codes)]) == good


@pytest.mark.parametrize(("codes", "good"), [(0x30, 1), (0x20, 1), (0x10, 0)])
def test_polarity_one_is_refused(library, codes, good):
    assert check(library, [block_of(1, SIZE, "0" * 26, codes=codes)]) == good
