"""The golden vectors and the page's worked examples: what other decoders are checked against."""

import json
import re
from pathlib import Path

import make_vectors
import numpy as np
import pytest
import slow_decoder

from firmware_protocol.events import EVENT
from firmware_protocol.telemetry.layout import BlockError
from firmware_protocol.telemetry.reading import decode_block

EXAMPLES = (Path(__file__).parents[3] / "docs/traces/messages.txt").read_text()
BLOCKS = json.loads((make_vectors.FOLDER / "blocks.json").read_text())
REFUSED = json.loads((make_vectors.FOLDER / "refused.json").read_text())


def named(vectors):
    return pytest.mark.parametrize("vector", vectors, ids=lambda vector: vector["name"])


@named(BLOCKS)
def test_vectors_decode(vector):
    data = bytes.fromhex(vector["hex"])
    block = decode_block(data, vector["near_us"])
    told = {
        "mode": block.header.mode.name,
        "tick_us": block.header.tick_us,
        "size": list(block.header.size),
        "dropped": block.header.dropped,
    }
    header, records = slow_decoder.decode(data, vector["near_us"])
    assert told == header == {key: vector[key] for key in told}
    if "edges" in vector:
        assert block.edges.tolist() == [tuple(row) for row in vector["edges"]] == records
    else:
        assert np.array_equal(block.events, np.array([tuple(row) for row in vector["events"]], EVENT))
        assert records == [tuple(row) for row in vector["events"]]


@named(REFUSED)
def test_malformed_vectors_are_refused(vector):
    data = bytes.fromhex(vector["hex"])
    with pytest.raises(BlockError):
        decode_block(data)
    with pytest.raises(slow_decoder.Refused, match=f"^{vector['why']}:"):
        slow_decoder.decode(data)


def test_the_vectors_are_what_the_encoder_writes():
    for name, text in make_vectors.files().items():
        assert (make_vectors.FOLDER / name).read_text() == text, f"run {make_vectors.__file__}"


def test_every_mode_tick_and_reason_has_a_vector():
    assert {vector["mode"] for vector in BLOCKS} == {"FLAT", "ROWS", "BITMAP", "EDGE"}
    assert {vector["tick_us"] for vector in BLOCKS} == {1, 10, 100, 1000}
    assert {vector["why"] for vector in REFUSED} == set(range(1, 8))


def hexes(name):
    """The bytes that stand behind a name in the list of examples."""
    (octets,) = re.findall(rf"^{name}: ((?:(?:[0-9A-F]{{2}})+ ?)+)", EXAMPLES, re.MULTILINE)
    return bytes.fromhex(octets)


def test_the_examples_of_the_page_are_true():
    header = bytes.fromhex("11 00 00 03 00 0F 42 40 00 00 15 91 03 0D")
    by_name = {vector["name"]: bytes.fromhex(vector["hex"]) for vector in BLOCKS}
    assert by_name["page: three events, ROWS"] == header + hexes("ROWS, payload")
    assert by_name["page: three events, FLAT"][14:] == hexes("FLAT, payload")
    assert by_name["page: a small BITMAP"] == hexes("BITMAP, with the header")
    assert decode_block(by_name["page: three events, ROWS"]).events.tolist() == make_vectors.THREE.tolist()
    x, y = (decode_block(by_name["page: a small BITMAP"]).events[name] for name in ("x", "y"))
    assert (y * 8 + x).tolist() == [10, 11, 13, 14, *range(16, 24)]


def test_the_check_value_of_the_header_checksum():
    assert slow_decoder.crc8(b"123456789") == 0xDF
