"""Poses from outside: on the next picture, in order, and told when late."""

import math
import select
import socket
import time

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from emulator.trajectory.building import build_trajectories
from emulator.trajectory.live import (
    LATE_PICTURES,
    LOST,
    NOT_ALLOWED,
    REFUSED,
    REPEATED,
    RESTARTS,
    STALE,
    TAKEN,
    TOO_FAR_AHEAD,
    UNKNOWN_BODY,
    LivePoses,
    PoseReceiver,
    ReceivedPath,
    SceneClock,
    close_receivers,
    live_counts,
)
from emulator.trajectory.parameters import FixedPath, LivePath
from emulator.trajectory.pose import Fixed, Pose, TrajectoryError, turn_rad
from firmware_protocol.pose_message import NOW, POSE_BYTES, PoseMessage, PoseMessageError

MS = 1_000_000


def message(t_ns, x=0.0, angle=0.0, counter=0):
    return PoseMessage(t_ns, (x, 0.0, 0.0), (math.cos(angle / 2), 0.0, 0.0, math.sin(angle / 2)), 0, counter)


def test_between_poses_it_goes_straight_and_along_the_great_circle():
    live = LivePoses()
    live.add(message(0, 0.0, 0.0), 0)
    live.add(message(10 * MS, 1.0, 0.4, counter=1), 10 * MS)
    pose = live.pose(5 * MS)
    assert pose.position_m[0] == pytest.approx(0.5)
    assert turn_rad(pose, Pose(np.zeros(3), np.array([math.cos(0.1), 0, 0, math.sin(0.1)]))) < 1e-12


@pytest.mark.parametrize("away_ns", [-MS, -1, 0, 1, MS])
@pytest.mark.parametrize("spacing_ms", [2, 40])
def test_around_a_pose_it_does_not_matter_whether_the_next_one_has_come(spacing_ms, away_ns):
    """Scenes take rates from poses 1 ms before and after a light frame; a camera in lockstep may lag its sender."""
    waits, lags = LivePoses(), LivePoses()
    for k, x in enumerate((0.0, 1.0, 3.0, 7.0)):
        lags.add(message(k * spacing_ms * MS, x, 0.1 * x, counter=k), 0)
        if k < 3:
            waits.add(message(k * spacing_ms * MS, x, 0.1 * x, counter=k), 0)
    first, second = (live.pose(2 * spacing_ms * MS + away_ns) for live in (waits, lags))
    np.testing.assert_array_equal(first.position_m, second.position_m)
    np.testing.assert_array_equal(first.q_world_from_body, second.q_world_from_body)


def test_two_poses_at_nearly_one_time_do_not_throw_the_body_away():
    live = LivePoses()
    for k, (t_ns, x) in enumerate([(0, 0.0), (40 * MS, 1.0), (40 * MS + 1000, 1.001), (80 * MS, 2.0)]):
        live.add(message(t_ns, x, counter=k), 0)
    assert 1.001 < live.pose(41 * MS).position_m[0] < 1.03


def test_the_last_motion_goes_on_for_a_while_and_then_stands_still_and_counts():
    live = LivePoses(hold_ns=20 * MS)
    live.add(message(0, 0.0), 0)
    live.add(message(10 * MS, 1.0, counter=1), 10 * MS)
    assert live.pose(25 * MS).position_m[0] == pytest.approx(2.5)
    assert live.counters[LATE_PICTURES] == 0
    assert live.pose(31 * MS).position_m[0] == live.pose(90 * MS).position_m[0] == pytest.approx(3.0)
    assert live.counters[LATE_PICTURES] == 2


def test_a_pose_for_now_is_on_the_next_picture():
    live = LivePoses()
    assert live.pose(0).position_m[0] == 0.0
    live.add(message(NOW, 7.0), 3 * MS)
    assert live.pose(3 * MS).position_m[0] == 7.0
    live.add(message(NOW, 8.0, counter=1), 4 * MS)
    assert live.pose(4 * MS).position_m[0] == 8.0


def test_old_poses_are_refused_and_missing_ones_counted():
    live = LivePoses()
    live.add(message(10 * MS, 1.0, counter=2**32 - 1), 10 * MS)
    live.add(message(9 * MS, 5.0, counter=0), 9 * MS)
    live.add(message(20 * MS, 2.0, counter=4), 20 * MS)
    assert (live.counters[TAKEN], live.counters[STALE], live.counters[LOST]) == (2, 1, 3)
    assert live.pose(20 * MS).position_m[0] == 2.0


def test_before_the_first_pose_the_rig_s_own_holds():
    live = LivePoses(Pose(np.array([9.0, 0, 0]), np.array([1.0, 0, 0, 0])))
    live.add(message(10 * MS, 1.0), 10 * MS)
    assert live.pose(5 * MS).position_m[0] == 9.0


def test_what_is_known_is_bounded():
    live = LivePoses()
    for k in range(1000):
        live.add(message(k * MS, float(k), counter=k), k * MS)
    assert live.pose(998 * MS + MS // 2).position_m[0] == pytest.approx(998.5)
    assert live.pose(0).position_m[0] == 936.0


@pytest.mark.parametrize("counters", [[5, 5], [5, 4], [5, 6, 5, 4, 6]])
def test_duplicates_and_overtaken_poses_are_no_loss(counters):
    """A difference without sign had reported 2 147 483 647 poses lost."""
    live = LivePoses()
    for k, counter in enumerate(counters):
        live.add(message(counter * MS, float(counter), counter=counter), k * MS)
    new = len({c for k, c in enumerate(counters) if all(c > earlier for earlier in counters[:k])})
    assert (live.counters[LOST], live.counters[RESTARTS]) == (0, 0)
    assert (live.counters[TAKEN], live.counters[REPEATED]) == (new, len(counters) - new)


def test_a_sender_that_does_not_count_is_heard():
    live = LivePoses()
    for k in range(3):
        live.add(message(NOW, float(k)), k * MS)
    assert (live.counters[TAKEN], live.counters[LOST], live.counters[REPEATED]) == (3, 0, 0)


@pytest.mark.parametrize("counters", [[5000, 0], [2**31, 0], [3, 2**31 + 7], [2**32 - 200, 2**31]])
def test_a_sender_that_begins_anew_is_no_loss(counters):
    live = LivePoses()
    for k, counter in enumerate(counters):
        live.add(message((k + 1) * MS, float(k), counter=counter), k * MS)
    assert (live.counters[LOST], live.counters[RESTARTS], live.counters[TAKEN]) == (0, 1, 2)


def test_one_pose_dated_in_the_far_future_locks_none_out():
    live = LivePoses(ahead_ns=10 * MS)
    live.add(message(0, 0.0), 0)
    live.add(message(2**62, 9.0, counter=1), 0)
    live.add(message(11 * MS, 9.0, counter=2), 0)
    live.add(message(10 * MS, 1.0, counter=1), 0)
    assert (live.counters[TOO_FAR_AHEAD], live.counters[TAKEN], live.counters[LOST]) == (2, 2, 0)
    assert live.pose(5 * MS).position_m[0] == 0.5


def test_a_pose_for_now_replaces_what_is_stamped_later():
    live = LivePoses()
    live.add(message(500 * MS, 5.0), 0)
    live.add(message(NOW, 1.0, counter=1), 7 * MS)
    assert live.pose(8 * MS).position_m[0] == 1.0


def test_a_second_look_at_the_beginning_keeps_the_newest_pose():
    """Scenes look at their paths a minute ahead before a run begins."""
    live = LivePoses(ahead_ns=100 * MS)
    live.add(message(NOW, 3.0), 60_000 * MS)
    live.restart(0)
    assert live.pose(0).position_m[0] == 3.0
    live.add(message(NOW, 4.0, counter=1), 1 * MS)
    assert live.pose(MS).position_m[0] == 4.0


def test_the_farthest_places_in_turn_stay_finite():
    live = LivePoses(hold_ns=60_000 * MS)
    for k, x in enumerate((1e15, -1e15, 1e15)):
        live.add(message(NOW, x, counter=k), k + 1)
    assert np.isfinite(live.pose(10**18).position_m).all()
    with pytest.raises(PoseMessageError, match="more than 1e"):
        message(NOW, 1e308)


def test_a_clock_puts_an_instant_on_the_scene_s_time():
    clock = SceneClock()
    for k in range(5):
        assert not clock.draw(k * 10 * MS, 7_000 * MS + k * 10 * MS + (k % 3) * MS)
    assert clock.scene_ns(7_012 * MS) == 12 * MS
    assert clock.scene_ns(7_090 * MS) == 40 * MS  # never after the picture that is being drawn
    assert clock.scene_ns(6_000 * MS) == 0
    assert not clock.draw(1_050 * MS, 8_050 * MS)
    assert clock.draw(0, 9_000 * MS)
    assert clock.scene_ns(9_000 * MS) == 0


@pytest.mark.parametrize("picture_ms", [1, 4, 7, 16])
def test_poses_for_now_move_at_their_own_speed_whatever_the_pictures(picture_ms):
    """100 poses a second of a body at 1 m/s: stamped by pictures their speed had been 0.5 to 2.0 of the truth."""
    wall_ns = 10**18
    receiver = PoseReceiver("127.0.0.1", 0, clock=lambda: wall_ns)
    path = ReceivedPath(receiver, 0)
    try:
        sent, seen = 0, []
        for k in range(1000 // picture_ms):
            t_ns = k * picture_ms * MS
            wall_ns = 10**18 + t_ns
            receiver.receive(t_ns)
            while sent * 10 * MS <= t_ns:
                receiver.take(bytes(message(NOW, sent * 0.01, counter=sent)), "127.0.0.1", 10**18 + sent * 10 * MS)
                sent += 1
            seen.append(path.pose(t_ns).position_m[0])
        speeds = np.diff(seen[len(seen) // 4 :]) / (picture_ms * 1e-3)
        assert np.abs(speeds - 1).max() < 1e-6
    finally:
        receiver.close()


def send(receiver, *datagrams):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for data in datagrams:
            sender.sendto(bytes(data), receiver.address)


@pytest.mark.socket
def test_a_datagram_is_on_the_very_next_picture():
    receiver = PoseReceiver("127.0.0.1", 0)
    path = ReceivedPath(receiver, 0)
    try:
        path.pose(0)
        turned = PoseMessage(NOW, (4.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0), body=2)
        send(receiver, message(NOW, 3.0), b"nonsense", turned)
        assert path.pose(MS).position_m[0] == 3.0
        assert path.counters[TAKEN] == 1
        assert (receiver.counters[REFUSED], receiver.counters[UNKNOWN_BODY]) == (1, 1)
        with pytest.raises(OSError, match="stop what holds the port"):
            PoseReceiver(*receiver.address)
    finally:
        receiver.close()


@pytest.mark.socket
def test_the_kernel_s_stamp_of_arrival_counts():
    """The picture is drawn 0.5 s after the pose has come, and the pose holds from its own arrival."""
    wall_ns = [begun_ns := time.time_ns()]
    receiver = PoseReceiver("127.0.0.1", 0, clock=lambda: wall_ns[-1])
    path = ReceivedPath(receiver, 0)
    try:
        path.pose(0)
        before_ns = time.time_ns()
        send(receiver, message(NOW, 3.0))
        after_ns = time.time_ns()
        assert select.select([receiver._socket], [], [], 120.0)[0]
        wall_ns.append(after_ns + 500 * MS)
        path.pose(after_ns - begun_ns + 400 * MS)
        assert before_ns - begun_ns <= path._known[-1].t_ns <= after_ns - begun_ns
    finally:
        receiver.close()


@pytest.mark.socket
def test_one_port_serves_the_camera_and_the_bodies_by_their_number():
    camera, still, body = build_trajectories([LivePath(port=0), FixedPath(), LivePath(port=0)])
    try:
        assert camera.receiver is body.receiver
        datagrams = [PoseMessage(NOW, (float(k), 0, 0), (1.0, 0, 0, 0), body=k, counter=9) for k in range(4)]
        send(camera.receiver, *datagrams)
        assert [path.pose(0).position_m[0] for path in (camera, still, body)] == [0.0, 0.0, 2.0]
        counts = live_counts(camera, still, body)
        assert (counts["poses taken"], counts["poses of unknown bodies"], counts["poses lost"]) == (2, 2, 0)
    finally:
        close_receivers(camera, still, body)


@pytest.mark.socket
def test_paths_that_share_a_port_agree_about_who_may_send():
    with pytest.raises(TrajectoryError, match="same addresses in `allow`"):
        build_trajectories([LivePath(port=0), LivePath(port=0, allow=("127.0.0.5",))])


@pytest.mark.socket
@pytest.mark.parametrize("allow", ["127.0.0.9", "127.0.0.8/29"])
def test_only_allowed_addresses_are_heard(allow):
    receiver = PoseReceiver("127.0.0.1", 0, allow=(allow,))
    path = ReceivedPath(receiver, 0)
    try:
        send(receiver, message(NOW, 3.0))
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
            sender.bind(("127.0.0.9", 0))
            sender.sendto(bytes(message(NOW, 5.0)), receiver.address)
        assert path.pose(0).position_m[0] == 5.0
        assert receiver.counters[NOT_ALLOWED] == 1
    finally:
        receiver.close()


@pytest.mark.parametrize("host", ["0.0.0.0", "192.168.1.2", "", "127.0.0.1.example.org"])
def test_a_port_beyond_this_machine_needs_names_of_senders(host):
    with pytest.raises(ValueError, match="can be reached from other machines: set allow"):
        LivePath(host=host)
    assert LivePath(host=host, allow=("192.168.1.5",)).allow
    with pytest.raises(ValueError, match="neither an address nor a network"):
        LivePath(host=host, allow=("everyone",))


class Flood:
    """A socket that never runs dry."""

    def __init__(self, data):
        self.data, self.read = data, 0

    def recvmsg(self, *_):
        self.read += 1
        return self.data, [], 0, ("127.0.0.1", 1)

    def close(self):
        pass


@pytest.mark.parametrize("data", [b"", bytes(message(NOW, 1.0)), bytes(message(2**62))])
def test_a_flood_is_read_in_bounded_bites(data):
    receiver = PoseReceiver("127.0.0.1", 0)
    receiver._socket.close()
    receiver._socket = flood = Flood(data)
    for k in range(5):
        for _ in range(3):
            receiver.receive(k)
    assert flood.read == 5 * 256


hostile = st.tuples(
    st.one_of(st.just(NOW), st.integers(0, 2**63 - 1), st.integers(0, 10**10)),
    st.tuples(*[st.floats(-1e15, 1e15)] * 3),
    st.integers(0, 3),
    st.integers(0, 2**32 - 1),
    st.integers(-(10**12), 10**12),
    st.floats(0, 7),
)


@given(st.lists(hostile, max_size=40))
def test_hostile_poses_leave_a_good_one_its_effect(poses):
    receiver = PoseReceiver("127.0.0.1", 0, clock=lambda: 10**18)
    path = ReceivedPath(receiver, 0)
    try:
        for k, (t_ns, place, body, counter, arrival, angle) in enumerate(poses):
            receiver.receive(k * MS)
            q = (math.cos(angle), math.sin(angle), 0.0, 0.0)
            receiver.take(bytes(PoseMessage(t_ns, place, q, body, counter)), "127.0.0.1", 10**18 + arrival)
            assert np.isfinite(path.pose(k * MS).position_m).all()
        end_ns = 40 * MS
        receiver.receive(end_ns)
        good = PoseMessage(NOW, (1.0, 2.0, 3.0), (1.0, 0.0, 0.0, 0.0), 0, 7)
        receiver._bodies[0]._last = None  # the counter is attacked in tests of its own
        receiver.take(bytes(good), "127.0.0.1", 10**18 + 10**15)
        np.testing.assert_array_equal(path.pose(end_ns).position_m, [1, 2, 3])
    finally:
        receiver.close()


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
    "bad",
    [
        {"t_ns": -2},
        {"position_m": (2e15, 0, 0)},
        {"position_m": (math.inf, 0, 0)},
        {"q_world_from_body": (1, 1, 0, 0)},
        {"body": 1 << 16},
    ],
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
def test_what_came_in_is_told_for_all_receivers_together():
    assert live_counts(Fixed()) == {}
    receivers = [PoseReceiver("127.0.0.1", 0) for _ in range(2)]
    paths = [ReceivedPath(receiver, 0, hold_ns=0) for receiver in receivers]
    for path in paths:
        send(path.receiver, message(0, 3.0), b"")
        path.pose(1)
    counts = live_counts(*paths, Fixed())
    assert (counts["poses taken"], counts["poses refused"], counts["pictures with a late pose"]) == (2, 2, 2)
    close_receivers(*paths, Fixed())
    assert [receiver._socket.fileno() for receiver in receivers] == [-1, -1]
