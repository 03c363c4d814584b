"""ISO-TP and CFP in C: the same packets, replies and counts as the Python receivers, whatever frames come."""

import struct

import numpy as np
import pytest
from block_strategies import stream
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import FD_LENGTHS, Frame
from firmware_protocol.can_frames.transport import CfpReceiver, IsoTpReceiver, IsoTpSender, IsoTpSettings, cfp_frames
from firmware_protocol.events import empty_events
from firmware_protocol.packets.addresses import Message, MessageKind
from firmware_protocol.packets.profile import Profile
from firmware_protocol.telemetry.reading import decode_block
from firmware_protocol.telemetry.writing import BlockEncoder

SIZE = (346, 260)
TELEMETRY, TELECOMMAND, CAPACITY = 0x4A2, 0x522, 1050
COUNTS = ("malformed", "too long", "out of order", "cut short by another {}", "without a beginning")
TO_PEER = 1 << 13 | 10 << 7


def request(frames):
    return b"".join(struct.pack("<IB", f.identifier, len(f.data)) + f.data for f in frames)


def block(seed, count=40):
    return BlockEncoder(SIZE).encode(stream(SIZE, count, 3000, seed, 1_000_000 * seed))[0]


def messages(count):
    return [Message(MessageKind.EVENTS, block(seed), 1_000_000 * seed) for seed in range(1, count + 1)]


def isotp_frames(payloads, *, fd=False):
    """Return the frames of messages, cut up without flow control."""
    sender, frames = IsoTpSender(IsoTpSettings(TELEMETRY, TELECOMMAND, fd=fd, flow_control=False)), []
    for payload in payloads:
        sender.start(payload)
        while sender.busy:
            frames.append(sender.next_frame(1 << 60))
    return frames


def events_in(unwrapper, packets):
    """Return the events of packets, and how many of them held a message."""
    received = [r for packet in packets for r in unwrapper.push(packet)]
    blocks = [decode_block(r.message.payload, r.message.t_us) for r in received if r.message.payload]
    return np.concatenate([empty_events(), *(b.events for b in blocks)]), len(received)


def same_isotp(library, frames, block_size=0, capacity=CAPACITY):
    receiver = IsoTpReceiver(
        IsoTpSettings(TELECOMMAND, TELEMETRY, block_size=block_size, separation=0, longest_bytes=capacity)
    )
    packets, replies = [], []
    for frame in frames:
        packet = receiver.push(frame, 0)
        packets += [] if packet is None else [packet]
        replies += [] if receiver.reply is None else [receiver.reply.data]
    reply = library("I", request(frames), flags=block_size, piece=capacity)
    assert reply.counters[-6:] == [len(packets), *[receiver.faults[name.format("message")] for name in COUNTS]]
    assert [frame for frame in reply.frames if len(frame) == 8] == replies
    events, _ = events_in(Profile("ccsds").unwrapper(), packets)
    assert np.array_equal(reply.events, events)
    return reply


def same_cfp(library, frames):
    receiver = CfpReceiver(1)
    packets = [p for frame in frames if (p := receiver.push(frame, 0)) is not None]
    reply = library("F", request(frames), piece=CAPACITY)
    assert reply.counters[-6] == len(packets)
    events, good = events_in(Profile("csp").unwrapper(), packets)
    assert np.array_equal(reply.events, events)
    assert reply.counters[0] == good
    return reply, receiver


@pytest.mark.parametrize("fd", [False, True])
@pytest.mark.parametrize("block_size", [0, 1, 8])
def test_messages_by_isotp_come_back(library, fd, block_size):
    sent = messages(6)
    frames = isotp_frames(map(Profile("ccsds").wrap, sent), fd=fd)
    reply = same_isotp(library, frames, block_size)
    assert (reply.counters[0], reply.counters[3]) == (6, 0)
    assert len(reply.events) == 6 * 40


@given(st.data())
def test_isotp_frames_lost_repeated_and_swapped_count_the_same(library, data):
    fd = data.draw(st.booleans())
    frames = isotp_frames(map(Profile("ccsds").wrap, messages(4)), fd=fd)
    order = data.draw(st.lists(st.integers(0, len(frames) - 1), max_size=20))
    kept = [i for i in range(len(frames)) if i not in order[::2]] + order[1::2]
    same_isotp(library, [frames[i] for i in kept], data.draw(st.integers(0, 3)))


CLASSIC = st.binary(max_size=8)
FD = st.sampled_from(FD_LENGTHS).flatmap(lambda n: st.binary(min_size=n, max_size=n))
ISOTP = st.builds(
    lambda kind, low, rest: bytes([kind << 4 | low]) + rest,
    st.integers(0, 3), st.one_of(st.just(0), st.just(1), st.integers(0, 15)), st.binary(max_size=63),
).map(lambda data: data[: max(n for n in FD_LENGTHS if n <= len(data))])  # fmt: skip


@given(
    st.lists(st.one_of(CLASSIC, FD, ISOTP), max_size=30), st.integers(0, 2), st.sampled_from([0, 1, 7, 20, CAPACITY])
)
def test_any_isotp_frames_count_the_same(library, datas, block_size, capacity):
    frames = [Frame(TELEMETRY, data, fd=True) for data in datas]
    if capacity < 64:  # the Python receiver has room for any single frame
        frames = [f for f in frames if not f.data or f.data[0] >> 4]
    same_isotp(library, frames, block_size, capacity)


def test_a_single_frame_that_does_not_fit_is_counted(library):
    reply = library("I", request([Frame(TELEMETRY, b"\x05hello"), Frame(TELEMETRY, b"\x04hell")]), piece=4)
    assert reply.counters[-6:] == [1, 0, 1, 0, 0, 0]


def test_messages_by_cfp_come_back(library):
    profile = Profile("csp")
    frames = [f for i, m in enumerate(messages(6)) for f in cfp_frames(profile.wrap(m), 10, i)]
    reply, _ = same_cfp(library, frames)
    assert (reply.counters[0], reply.counters[3], len(reply.events)) == (6, 0, 6 * 40)
    assert reply.counters[-5:] == [0] * 5


@given(st.lists(st.integers(0, 200), max_size=12))
def test_cfp_frames_lost_and_repeated_cost_their_packet_and_nothing_is_made_up(library, hit):
    profile = Profile("csp")
    frames = [f for i, m in enumerate(messages(4)) for f in cfp_frames(profile.wrap(m), 10, i)]
    lost, again = {i % len(frames) for i in hit[::2]}, {i % len(frames) for i in hit[1::2]}
    damaged = [f for i, frame in enumerate(frames) if i not in lost for f in [frame] * (2 if i in again else 1)]
    reply, _ = same_cfp(library, damaged)
    known = {tuple(e) for m in messages(4) for e in decode_block(m.payload, m.t_us).events.tolist()}
    assert {tuple(e) for e in reply.events.tolist()} <= known


@given(st.lists(st.tuples(st.integers(0, 127), CLASSIC), max_size=60))
def test_any_cfp_frames_of_one_packet_at_a_time_count_the_same(library, numbers):
    frames = [Frame(TO_PEER | number & 31, data, extended=True) for number, data in numbers]  # one packet count
    reply, receiver = same_cfp(library, frames)
    assert reply.counters[-5:] == [receiver.faults[name.format("packet")] for name in COUNTS]


def test_cfp_frames_of_others_are_passed_over_and_long_packets_refused(library):
    (frame,) = cfp_frames(Profile("csp").wrap(Message(MessageKind.PONG, b"", 5))[:9], 10, 0)
    others = [Frame(frame.identifier ^ bit, frame.data, extended=True) for bit in (1 << 13, 1 << 7)]
    assert library("F", request(others), piece=CAPACITY).counters[-6:] == [0] * 6
    assert library("F", request([frame]), piece=8).counters[-6:] == [0, 0, 1, 0, 0, 0]
    assert library("F", request([frame]), piece=9).counters[-6:] == [1, 0, 0, 0, 0, 0]
    longer = struct.pack("<IB", frame.identifier, 9) + bytes(9)
    assert library("F", longer, piece=CAPACITY).counters[-6:] == [0, 1, 0, 0, 0, 0]


def test_packets_of_another_priority_begin_anew(library):
    low = cfp_frames(Profile("csp").wrap(messages(1)[0]), 10, 0)
    normal = cfp_frames(Profile("csp").wrap(Message(MessageKind.HOUSEKEEPING, bytes(20), 5)), 10, 1)
    reply = library("F", request(low[:3] + normal + low[3:]), piece=CAPACITY)
    assert reply.counters[-6:] == [1, 0, 0, 0, 1, len(low) - 3]
    assert reply.counters[:3] == [0, 1, 0]
