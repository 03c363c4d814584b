"""Poses from outside: on the next picture, in order, and told when late."""

import math
import socket

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.trajectory.live import Inlet, LivePoses, close_inlets, live_counts
from emulator.trajectory.measured import turn_rad
from emulator.trajectory.pose import Fixed, Pose
from firmware_protocol.pose_message import NOW, POSE_BYTES, PoseMessage, PoseMessageError

MS = 1_000_000


def message(t_ns, x=0.0, angle=0.0, counter=0):
    return PoseMessage(t_ns, (x, 0.0, 0.0), (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)), 0, counter)


def test_between_poses_it_goes_straight_and_along_the_great_circle():
    live = LivePoses()
    live.add(message(0, 0.0, 0.0))
    live.add(message(10 * MS, 1.0, 0.4, counter=1))
    pose = live.pose(5 * MS)
    assert pose.position_m[0] == pytest.approx(0.5)
    assert turn_rad(pose, Pose(np.zeros(3), np.array([math.cos(0.1), 0, 0, math.sin(0.1)]))) < 1e-12


def test_the_last_motion_goes_on_for_a_while_and_then_stands_still_and_counts():
    live = LivePoses(hold_ns=20 * MS)
    live.add(message(0, 0.0))
    live.add(message(10 * MS, 1.0, counter=1))
    assert live.pose(25 * MS).position_m[0] == pytest.approx(2.5)
    assert live.counters.late_pictures == 0
    assert live.pose(31 * MS).position_m[0] == live.pose(90 * MS).position_m[0] == pytest.approx(3.0)
    assert live.counters.late_pictures == 2


def test_a_pose_for_now_is_on_the_next_picture():
    live = LivePoses()
    assert live.pose(0).position_m[0] == 0.0
    live.add(message(NOW, 7.0))
    assert live.pose(3 * MS).position_m[0] == 7.0
    live.add(message(NOW, 8.0, counter=1))
    assert live.pose(4 * MS).position_m[0] == 8.0


def test_old_poses_are_refused_and_missing_ones_counted():
    live = LivePoses()
    live.add(message(10 * MS, 1.0, counter=2**32 - 1))
    live.add(message(9 * MS, 5.0, counter=0))
    live.add(message(20 * MS, 2.0, counter=4))
    assert (live.counters.taken, live.counters.stale, live.counters.lost) == (2, 1, 3)
    assert live.pose(20 * MS).position_m[0] == 2.0


def test_before_the_first_pose_the_rig_s_own_holds():
    live = LivePoses(Pose(np.array([9.0, 0, 0]), np.array([1.0, 0, 0, 0])))
    live.add(message(10 * MS, 1.0))
    assert live.pose(5 * MS).position_m[0] == 9.0


def test_what_is_known_is_bounded():
    live = LivePoses()
    for k in range(1000):
        live.add(message(k * MS, float(k), counter=k))
    assert live.pose(998 * MS + MS // 2).position_m[0] == pytest.approx(998.5)
    assert live.pose(0).position_m[0] == 936.0


@pytest.mark.socket
def test_a_datagram_is_on_the_very_next_picture():
    inlet = Inlet("127.0.0.1", 0, LivePoses())
    try:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(bytes(message(NOW, 3.0)), inlet.address)
            sender.sendto(b"nonsense", inlet.address)
            sender.sendto(bytes(PoseMessage(NOW, (4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), body=2)), inlet.address)
        assert inlet.pose(0).position_m[0] == 3.0
        assert (inlet.counters.taken, inlet.counters.refused) == (1, 1)
        with pytest.raises(OSError, match="stop what holds the port"):
            Inlet(*inlet.address, LivePoses())
    finally:
        inlet.close()


@given(st.integers(-1, 2**63 - 1), st.tuples(*[st.floats(-1e12, 1e12)] * 3), st.floats(0, 6.28), st.integers(0, 65535))
def test_a_message_comes_back(t_ns, place, angle, body):
    sent = PoseMessage(t_ns, place, (math.cos(angle), math.sin(angle), 0.0, 0.0), body, 2**32 - 1)
    assert PoseMessage.parse(bytes(sent)) == sent
    assert len(bytes(sent)) == POSE_BYTES


@given(st.binary(max_size=2 * POSE_BYTES), st.integers(0, 8 * POSE_BYTES - 1))
def test_damage_is_refused(noise, bit):
    damaged = bytearray(bytes(message(5)))
    damaged[bit // 8] ^= 1 << bit % 8
    for data in (noise, bytes(damaged), bytes(message(5))[:-1]):
        with pytest.raises(PoseMessageError):
            PoseMessage.parse(data)


@pytest.mark.parametrize(
    "bad", [{"t_ns": -2}, {"position_m": (math.inf, 0, 0)}, {"q_world_from_body": (1, 1, 0, 0)}, {"body": 1 << 16}]
)
def test_a_message_refuses_nonsense(bad):
    good = {"t_ns": 0, "position_m": (0.0, 0.0, 0.0), "q_world_from_body": (1.0, 0.0, 0.0, 0.0)}
    with pytest.raises(PoseMessageError):
        PoseMessage(**{**good, **bad})


def test_the_layout_is_the_documented_one():
    data = bytes(message(1, x=1.0, counter=0x01020304))
    assert data[:8] == b"EVPO\x01\x00\x00\x00"
    assert data[8:16] == (1).to_bytes(8, "little")
    assert data[16:24].hex() == "000000000000f03f"
    assert data[72:76] == bytes([4, 3, 2, 1])


@pytest.mark.socket
def test_what_came_in_is_told_for_all_inlets_together():
    assert live_counts(Fixed()) == {}
    inlets = [Inlet("127.0.0.1", 0, LivePoses(hold_ns=0)) for _ in range(2)]
    for inlet in inlets:
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.sendto(bytes(message(0, 3.0)), inlet.address)
        inlet.pose(1)
    counts = live_counts(*inlets, Fixed())
    assert (counts["poses taken"], counts["pictures with a late pose"]) == (2, 2)
    close_inlets(*inlets, Fixed())
    assert [inlet._socket.fileno() for inlet in inlets] == [-1, -1]
