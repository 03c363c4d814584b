"""ISO-TP against the Python package can-isotp, and against peers that misbehave."""

import isotp
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.transport import (
    IsoTpFailure,
    IsoTpReceiver,
    IsoTpSender,
    IsoTpSettings,
    separation_ns,
)

OURS, THEIRS = 0x4A2, 0x522


def oracle(inbox, outbox, fd, block_size):
    """can-isotp on the far end: reads Frames from `inbox`, writes Frames to `outbox`."""

    def receive(_timeout):
        frame = inbox.pop(0) if inbox else None
        if frame is None:
            return None
        return isotp.CanMessage(arbitration_id=frame.identifier, data=frame.data, is_fd=frame.fd)

    def send(message):
        outbox.append(Frame(message.arbitration_id, bytes(message.data), fd=message.is_fd))

    params = {
        "blocking_send": False,
        "stmin": 0,
        "blocksize": block_size,
        "can_fd": fd,
        "tx_data_length": 64 if fd else 8,
    }
    params |= {"tx_padding": 0xCC, "max_frame_size": 70_000}
    return isotp.TransportLayerLogic(receive, send, isotp.Address(txid=THEIRS, rxid=OURS), params=params)


@given(st.integers(1, 300) | st.sampled_from([4095, 4096, 10_000]), st.booleans(), st.sampled_from([0, 1, 7]))
def test_can_isotp_reads_what_we_send(length, fd, block_size):
    message = bytes(i * 7 & 0xFF for i in range(length))
    to_them, to_us = [], []
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS, fd=fd))
    them = oracle(to_them, to_us, fd, block_size)
    sender.start(message)
    got = None
    for now_ns in range(0, 10**9, 1000):
        frame = sender.next_frame(now_ns)
        if frame is not None:
            to_them.append(frame)
        them.process()
        while to_us:
            sender.flow_control(to_us.pop(0), now_ns)
        got = them.recv()
        if got is not None:
            break
    assert got == message
    assert not sender.busy


@given(st.integers(1, 300) | st.sampled_from([4095, 4096, 10_000]), st.booleans(), st.sampled_from([0, 1, 7]))
def test_we_read_what_can_isotp_sends(length, fd, block_size):
    message = bytes(i * 11 & 0xFF for i in range(length))
    to_them, to_us = [], []
    receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS, fd=fd, block_size=block_size))
    them = oracle(to_them, to_us, fd, 0)
    them.send(message)
    got = None
    while got is None:
        them.process()
        while to_us and got is None:
            got = receiver.push(to_us.pop(0), 0)
            if receiver.reply is not None:
                to_them.append(receiver.reply)
    assert got == message
    assert not receiver.faults


def frames_of(message, **more):
    sender = IsoTpSender(IsoTpSettings(THEIRS, OURS, flow_control=False, **more))
    sender.start(message)
    frames = []
    while sender.busy:
        frames.append(sender.next_frame(0))
    return frames


def test_golden_frames():
    assert [str(f) for f in frames_of(b"abc")] == ["522#03616263CCCCCCCC"]
    assert [str(f) for f in frames_of(bytes(range(9)))] == ["522#1009000102030405", "522#21060708CCCCCCCC"]


@given(st.data())
def test_a_hole_costs_its_own_message_only(data):
    """All but lost blocks of sixteen frames, which ISO-TP itself cannot see, are found."""
    messages = [bytes([k]) * data.draw(st.integers(1, 90)) for k in range(4)]
    frames = [(k, frame) for k, message in enumerate(messages) for frame in frames_of(message)]
    lost = data.draw(st.integers(0, len(frames) - 1))
    receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS))
    got = [receiver.push(frame, 0) for i, (_, frame) in enumerate(frames) if i != lost]
    assert [m for m in got if m is not None] == [m for k, m in enumerate(messages) if k != frames[lost][0]]


@given(st.lists(st.binary(min_size=0, max_size=8), max_size=40))
def test_foreign_frames_hurt_nobody(payloads):
    receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS, longest_bytes=500))
    for data in payloads:
        message = receiver.push(Frame(THEIRS, data), 0)
        assert message is None or 0 < len(message) <= 500


def test_repeated_and_swapped_frames_are_out_of_order():
    frames = frames_of(bytes(40))
    for wrong in ([*frames[:2], frames[1], *frames[2:]], [frames[0], frames[2], frames[1], *frames[3:]]):
        receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS))
        assert [receiver.push(frame, 0) for frame in wrong] == [None] * len(wrong)
        assert receiver.faults["out of order"] == 1


def test_a_message_that_is_too_long_is_refused_with_an_overflow():
    receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS, longest_bytes=20))
    receiver.push(frames_of(bytes(21))[0], 0)
    assert receiver.reply.data[0] == 0x32
    assert receiver.faults["too long"] == 1


def test_a_peer_that_never_answers_is_named():
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS, timeout_ns=1000))
    sender.start(bytes(100))
    assert sender.next_frame(0) is not None
    assert sender.next_frame(1000) is None
    with pytest.raises(IsoTpFailure, match=r"0x522.*in time"):
        sender.next_frame(1001)
    assert not sender.busy


@pytest.mark.parametrize(("status", "why"), [(0x32, "no room"), (0x35, "bad flow status")])
def test_a_peer_that_refuses(status, why):
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS))
    sender.start(bytes(100))
    sender.next_frame(0)
    with pytest.raises(IsoTpFailure, match=why):
        sender.flow_control(Frame(THEIRS, bytes([status, 0, 0])), 0)


def test_a_peer_that_only_says_wait():
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS, waits=2))
    sender.start(bytes(100))
    sender.next_frame(0)
    wait = Frame(THEIRS, b"\x31\0\0")
    sender.flow_control(wait, 0)
    sender.flow_control(wait, 0)
    with pytest.raises(IsoTpFailure, match="wait"):
        sender.flow_control(wait, 0)


def test_frames_keep_the_separation_that_the_peer_asks_for():
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS))
    sender.start(bytes(30))
    sender.next_frame(0)
    sender.flow_control(Frame(THEIRS, b"\x30\x00\xf3"), 100)
    assert sender.next_frame(100) is not None
    assert sender.next_frame(300_099) is None
    assert sender.next_frame(300_100) is not None
    assert (separation_ns(0x7F), separation_ns(0x80)) == (127_000_000, 127_000_000)


def test_no_more_frames_leave_than_the_peer_has_room_for():
    sender = IsoTpSender(IsoTpSettings(OURS, THEIRS, timeout_ns=1000))
    sender.start(bytes(60))
    sender.next_frame(0)
    for _ in range(2):
        sender.flow_control(Frame(THEIRS, b"\x30\x02\x00"), 0)
        assert [sender.next_frame(0) is not None for _ in range(3)] == [True, True, False]
    with pytest.raises(IsoTpFailure, match="in time"):
        sender.next_frame(1001)


def test_a_message_that_stays_away_times_out():
    receiver = IsoTpReceiver(IsoTpSettings(OURS, THEIRS, timeout_ns=10))
    first, second, *_ = frames_of(bytes(40))
    receiver.push(first, 0)
    receiver.push(second, 11)
    assert receiver.faults == {"timed out": 1, "without a beginning": 1}
