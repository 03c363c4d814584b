"""CFP 2: frames as libcsp makes them, and the hole of eight frames that only a CRC can find."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.frame import Frame
from firmware_protocol.can_frames.transport import CfpReceiver, cfp_frames


def crc32c(data):
    crc = 0xFFFF_FFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F6_3B78 if crc & 1 else 0)
    return crc ^ 0xFFFF_FFFF


def packet(payload, priority=2, destination=10, source=5, ports=(7, 8), flags=1):
    header = priority << 46 | destination << 32 | source << 18 | ports[0] << 12 | ports[1] << 6 | flags
    return header.to_bytes(6, "big") + payload


def test_the_frames_that_libcsp_sends():
    # Worked out from csp_can2_tx: priority 2, destination 10, sender 5, packet count 3.
    first, second, third = cfp_frames(packet(bytes(range(13))), sender=5, packet_count=3)
    fixed = 2 << 27 | 10 << 13 | 5 << 7 | 3 << 5
    assert first == Frame(
        fixed | 2, (5 << 18 | 7 << 12 | 8 << 6 | 1).to_bytes(4, "big") + bytes(range(4)), extended=True
    )
    assert second == Frame(fixed | 1 << 2, bytes(range(4, 12)), extended=True)
    assert third == Frame(fixed | 2 << 2 | 1, b"\x0c", extended=True)


@pytest.mark.parametrize(
    ("k", "length", "frames"),
    [
        (0, 0, "00014343#00147C00"),
        (1, 1, "087E4363#0FB08C4100"),
        (2, 4, "10FB4303#1F4C9C8200070E15"),
        (3, 5, "19784322#2EE8ACC300070E15 19784325#1C"),
    ],
)
def test_frames_made_by_libcsps_own_code(k, length, frames):
    """What csp_can2_tx of libcsp, compiled and run (address 70, packet counter from 2), sends."""
    whole = packet(
        bytes(7 * i for i in range(length)),
        k,
        destination=10 + 1000 * k,
        source=5 + 999 * k,
        ports=(7 + k, 48 + k),
        flags=k,
    )
    assert " ".join(str(frame) for frame in cfp_frames(whole, 70, 2 + k)) == frames


def test_a_short_packet_is_one_frame():
    (only,) = cfp_frames(packet(b""), sender=70, packet_count=4)
    assert only.identifier & 3 == 3
    assert only.identifier >> 7 & 63 == 6
    assert only.identifier >> 5 & 3 == 0
    with pytest.raises(ValueError, match="header"):
        cfp_frames(b"short", 0, 0)


@given(st.lists(st.binary(max_size=150), max_size=6))
def test_packets_come_back(payloads):
    receiver = CfpReceiver()
    got = [receiver.push(frame, 0) for k, payload in enumerate(payloads) for frame in cfp_frames(packet(payload), 5, k)]
    assert [one for one in got if one is not None] == [packet(payload) for payload in payloads]
    assert not receiver.faults


@given(st.binary(min_size=20, max_size=60), st.binary(min_size=20, max_size=60), st.randoms())
def test_packets_of_two_senders_may_mingle(one, two, random):
    queues = [cfp_frames(packet(one, source=1), 1, 0), cfp_frames(packet(two, source=2), 2, 0)]
    receiver, got = CfpReceiver(), []
    while any(queues):
        queue = random.choice([q for q in queues if q])
        got.append(receiver.push(queue.pop(0), 0))
    assert sorted(g for g in got if g) == sorted([packet(one, source=1), packet(two, source=2)])


@given(st.binary(min_size=100, max_size=200), st.data())
def test_any_hole_is_found_by_the_frame_count_or_by_the_crc(payload, data):
    whole = packet(payload + crc32c(payload).to_bytes(4, "big"))
    frames = cfp_frames(whole, 5, 0)
    start = data.draw(st.integers(0, len(frames) - 1))
    hole = data.draw(st.integers(1, min(9, len(frames) - start)))
    receiver = CfpReceiver()
    for frame in frames[:start] + frames[start + hole :]:
        got = receiver.push(frame, 0)
        if got is not None:
            body = got[6:-4]
            assert hole == 8
            assert crc32c(body).to_bytes(4, "big") != got[-4:]


def test_the_hole_of_eight_frames_hides_from_the_frame_count():
    frames = cfp_frames(packet(bytes(200)), 5, 0)
    receiver = CfpReceiver()
    assert len([receiver.push(frame, 0) for frame in frames[:3] + frames[11:]][-1]) == 206 - 64
    assert not receiver.faults


def test_faults_are_told_apart():
    receiver = CfpReceiver(address=10)
    first, second, third = cfp_frames(packet(bytes(13)), 5, 0)
    assert receiver.push(second, 0) is None
    receiver.push(first, 0)
    receiver.push(third, 0)
    receiver.push(first, 0)
    receiver.push(first, 0)
    receiver.push(Frame(first.identifier, b"\0", extended=True), 0)
    assert receiver.faults == {
        "without a beginning": 1,
        "out of order": 1,
        "cut short by another packet": 2,
        "malformed": 1,
    }
    for frame in cfp_frames(packet(bytes(13), destination=11), 5, 0):
        assert receiver.push(frame, 0) is None


def test_packets_that_never_end_do_not_pile_up():
    receiver = CfpReceiver()
    for sender in range(1000):
        receiver.push(cfp_frames(packet(bytes(20), destination=sender), 5, 0)[0], 0)
    assert receiver.faults["timed out"] == 1000 - 64


@given(st.lists(st.tuples(st.integers(0, (1 << 29) - 1), st.binary(max_size=8)), max_size=60))
def test_foreign_frames_hurt_nobody(frames):
    receiver = CfpReceiver()
    for identifier, data in frames:
        got = receiver.push(Frame(identifier, data, extended=True), 0)
        assert got is None or len(got) >= 6
