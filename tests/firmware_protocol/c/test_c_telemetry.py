"""Serial telemetry in C, written from docs/packets.md: the same messages as the Python unwrapper, whatever comes."""

import binascii
import struct

import numpy as np
import pytest
from block_strategies import stream
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import empty_edges, empty_events, make_edges
from firmware_protocol.framing import sealed
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.layout import BlockError
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder

SIZE = (346, 260)
MODES = {"ccsds-cobs": "C", "ccsds-slip": "S", "ccsds-kiss": "K", "csp-kiss": "X"}
SCIENCE = (MessageKind.EVENTS, MessageKind.EDGES)
# The second message of docs/packets.md's kind: one that a reader can check by hand.
PAGE = bytes.fromhex("0aa1c000001620808100000000000000018000006120626c6f636bb787")


def events_message(seed, t_us, count=40):
    data, _ = BlockEncoder(SIZE).encode(stream(SIZE, count, 3000, seed, t_us), dropped=seed % 3)
    return Message(MessageKind.EVENTS, data, t_us + 1000)


def edges_message(t_us):
    edges = make_edges((t_us, t_us + 7), (2, 3))
    return Message(MessageKind.EDGES, BlockEncoder(SIZE).encode_edges(edges), t_us)


TIMES_US = st.one_of(st.integers(0, 2**32), st.integers(0, 2**32 * 1_000_000 - 10_000))
MESSAGES = st.one_of(
    st.builds(events_message, st.integers(0, 2**20), TIMES_US),
    st.builds(edges_message, TIMES_US),
    st.builds(Message, st.sampled_from([MessageKind.HOUSEKEEPING, MessageKind.TIME, *SCIENCE]), st.binary(), TIMES_US),
)


def python_says(name, data):
    """Return (events, edges, counters by name) of the Python receiver."""
    received = Profile(name).unwrapper().push(data)
    science = [r for r in received if r.message.kind in SCIENCE]
    blocks, refused = [], 0
    for r in science:
        try:
            blocks.append(decode_block(r.message.payload, r.message.t_us))
        except BlockError:
            refused += 1
    other_size = [block for block in blocks if block.header.size != SIZE]
    blocks = [block for block in blocks if block.header.size == SIZE]
    counters = {
        "packets": len(science),
        "missing": sum(r.missing for r in science),
        "blocks": [len(blocks), refused, len(other_size)],
        "dropped": sum(block.header.dropped for block in blocks),
    }
    events = np.concatenate([empty_events(), *(block.events for block in blocks)])
    return events, np.concatenate([empty_edges(), *(block.edges for block in blocks)]), counters


def same_as_python(library, name, data, piece=1 << 20):
    reply = library(MODES[name], data, size=SIZE, piece=piece)
    events, edges, counters = python_says(name, data)
    assert np.array_equal(reply.events, events)
    assert np.array_equal(reply.edges, edges)
    c = reply.counters
    told = {"packets": c[0], "missing": c[3], "blocks": c[5:8], "dropped": c[10]}
    assert told == counters
    return reply


CSP_PAGE = bytes.fromhex("c00100289200000000000001800000 6120626c6f636b cb252902")


@pytest.mark.parametrize(
    ("at", "value"),
    # Destination, source and port; the source port is free.
    [(1, 2), (0, 0xC1), (3, 0x2C), (4, 0x82), (4, 0xF2), (5, 0xFF)],
)
def test_csp_packets_that_are_not_ours_are_refused(library, at, value):
    packet = bytearray(CSP_PAGE[:-4])
    packet[at] = value
    assert library("Y", sealed(bytes(packet))).counters[:3] == ([1, 0, 0] if at == 5 else [0, 0, 1])
    assert library("Y", bytes(packet) + CSP_PAGE[-4:]).counters[:3] == [0, 0, 1]


def test_csp_answers_are_reports(library):
    profile = Profile("csp")
    kinds = (MessageKind.VERIFICATION, MessageKind.HOUSEKEEPING, MessageKind.TIME, MessageKind.PONG)
    told = [library("Y", profile.wrap(Message(kind, b"\x02data", 7))).frames for kind in kinds]
    head = struct.pack("<Q", 7)
    assert told == [
        [b"\x01\x02" + head + b"data"],
        *([bytes(type_) + head + b"\x02data"] for type_ in ((3, 25), (9, 2), (17, 2))),
    ]
    assert library("Y", profile.wrap(Message(MessageKind.VERIFICATION, b"", 7))).counters[:3] == [0, 0, 1]
    assert library("Y", sealed(CSP_PAGE[:14])).counters[:3] == library("Y", b"").counters[:3] == [0, 0, 1]


def test_events_and_edges_by_csp_have_counts_of_their_own(library):
    profile = Profile("csp-kiss")
    frames = [profile.wrap(m) for seed in range(5) for m in (events_message(seed, 1000), edges_message(1000))]
    reply = library("X", b"".join(frames[:2] + frames[4:7] + frames[9:]), size=SIZE)
    assert reply.counters[:5] == [6, 0, 0, 1 + 1 + 1, 0]


@pytest.mark.parametrize("name", MODES)
@given(st.lists(MESSAGES, max_size=8), st.integers(1, 100))
def test_messages_come_back(library, name, messages, piece):
    profile = Profile(name)
    reply = same_as_python(library, name, b"".join(map(profile.wrap, messages)), piece)
    assert reply.counters[0] + reply.counters[1] == len(messages)
    others = [m for m in messages if m.kind not in SCIENCE]
    assert [(struct.unpack_from("<Q", r, 2)[0], r[10:]) for r in reply.frames] == [(m.t_us, m.payload) for m in others]


@pytest.mark.parametrize("name", MODES)
@given(st.data())
def test_damaged_streams_give_the_same_and_nothing_wrong(library, name, data):
    profile = Profile(name)
    messages = [events_message(seed, 1_000_000 * seed) for seed in range(1, 7)]
    stream_ = bytearray(b"".join(map(profile.wrap, messages)))
    for _ in range(data.draw(st.integers(1, 4))):
        at, kind, value = data.draw(st.tuples(st.integers(0, len(stream_) - 1), st.integers(0, 2), st.integers(1, 255)))
        stream_[at : at + 1] = [bytes([stream_[at] ^ value]), b"", bytes([stream_[at], value])][kind]
    reply = same_as_python(library, name, bytes(stream_))
    sent = {tuple(event) for m in messages for event in decode_block(m.payload, m.t_us).events.tolist()}
    assert {tuple(event) for event in reply.events.tolist()} <= sent


@pytest.mark.parametrize("name", MODES)
def test_lost_repeated_and_late_packets_are_told_apart(library, name):
    profile = Profile(name)
    frames = [profile.wrap(events_message(seed, 1000)) for seed in range(8)]
    order = [0, 1, 4, 4, 3, 6]
    reply = library(MODES[name], b"".join(frames[i] for i in order), size=SIZE)
    assert reply.counters[0] == len(order)
    assert reply.counters[3:5] == [2 + 2, 2]  # 2, 3 before 4, and 4, 5 before 6; the second 4, and 3


def resealed(packet):
    return packet[:-2] + binascii.crc_hqx(packet[:-2], 0xFFFF).to_bytes(2, "big")


@pytest.mark.parametrize(
    ("at", "value"),
    [(0, 0x2A), (0, 0x1A), (0, 0x02), (1, 0xA2), (2, 0x40), (5, 0x17), (6, 0x10), (7, 0x81), (8, 0x83), (20, 0x62)],
)
def test_packets_that_are_not_ours_are_refused(library, at, value):
    packet = bytearray(PAGE)
    packet[at] = value
    assert library("P", resealed(bytes(packet)) if at != 20 else bytes(packet)).counters[:4] == [0, 0, 1, 0]


def test_idle_packets_are_passed_over(library):
    assert library("P", bytes.fromhex("07ffc000000355555555")).counters[:3] == [0, 1, 0]
