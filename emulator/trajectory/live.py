"""Poses that come from outside while the run goes on, and their reception: the closed loop.

A `GivenPath` gets its poses from a program that waits for the run, such as a simulation; all below is of poses in real
time. The pose of a light frame of time t:

    between two known poses     the pose is interpolated: straight line, great circle
    up to 1 ms after a pose     the motion to this pose goes on, also where the next pose is known already
    after the newest one        the last motion goes on for at most `hold_ns`; then the body is at rest, and every
                                light frame is counted as late
    before the first one        the pose that the rig gives

Scenes take rates of light from the poses 1 ms before and after a light frame. A sender in lockstep stamps its poses
with the times of light frames, and the next one may come before the frame is drawn or after it. The second rule makes
the rate the same in both cases, for fewer than 1000 poses a second.

A pose with a time is refused as stale when it is not newer than the newest one, and as too far ahead when it is stamped
more than `ahead_ns` beyond its arrival: otherwise one wrong time would make all later poses stale. A pose for now (time
-1) holds from its arrival, and replaces all poses that are stamped later.

The sender's counter is compared as a signed difference of 32 bits to the last one: 2 to 65 536 more is a loss, 1 to 64
less is a pose that others overtook, and is refused, as is the same pose again; any other jump is a restarted sender.
Poses of a sender that does not count (other poses with the same counter) are used.

A `PoseReceiver` is one UDP port for the camera and any number of bodies, each datagram with the number of a body, one
datagram a pose (layout: `firmware_protocol.pose_message`). All datagrams that have come are read before a light
frame is drawn, so a pose acts within one frame; at most 256 datagrams a frame, so that a flood cannot delay the run.

A datagram is used only if its sender is allowed, it is a pose, and its body is known; all others are counted. The
kernel stamps each one with the wall clock (`SO_TIMESTAMPNS`) and counts those that it had no room for (`SO_RXQ_OVFL`);
see socket(7). `SceneClock` turns the stamps into the scene's time.
"""

from __future__ import annotations

import math
import socket
import struct
import time
from collections import Counter, deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from emulator.geometry.attitude import conjugate, multiply, quaternion_of_vector
from emulator.trajectory.pose import (
    AT_REST,
    FARTHEST_M,
    STILL,
    Bounds,
    Motion,
    Pose,
    Trajectory,
    TrajectoryError,
    rotation_vector,
)
from firmware_protocol.pose_message import NOW, POSE_BYTES, PoseMessage, PoseMessageError
from transports.network import AllowList

_KNOWN = 64
_HOLD_NS, _AHEAD_NS = 100_000_000, 1_000_000_000
_GOES_ON_NS = 1_000_000
_MOST_LOST = 1 << 16
_MOST_OVERTAKEN = 64


TAKEN = "poses taken"
STALE = "poses stale"  # not newer than one that was there
TOO_FAR_AHEAD = "poses too far ahead"  # stamped too far beyond their arrival, refused
REPEATED = "poses repeated"  # duplicates and poses that others overtook, refused
LOST = "poses lost"  # missing by the sender's counter
RESTARTS = "restarts of a pose sender"  # jumps of the counter that are neither a loss nor a repetition
LATE_PICTURES = "pictures with a late pose"  # drawn with a pose that had stood still for want of a newer one
REFUSED = "poses refused"  # datagrams that are no pose
NOT_ALLOWED = "poses from addresses not allowed"
UNKNOWN_BODY = "poses of unknown bodies"  # that are not registered
DROPPED_BY_SYSTEM = "poses dropped by the system"  # which had no room for them

_OF_BODY = (TAKEN, STALE, TOO_FAR_AHEAD, REPEATED, LOST, RESTARTS, LATE_PICTURES)
_OF_PORT = (REFUSED, NOT_ALLOWED, UNKNOWN_BODY, DROPPED_BY_SYSTEM)


class TimedPose(NamedTuple):
    """A pose and its time; `on_arrival`: the sender gave no time."""

    t_ns: int
    pose: Pose
    on_arrival: bool = False


class ComingPoses(Trajectory):
    """A path whose poses are still coming: their bounds are not known."""

    bounds = Bounds(math.inf, math.inf)


class LivePoses(ComingPoses):
    """A path whose poses `add` gives.

    Parameters
    ----------
    first : the pose until one comes.
    hold_ns : time for which the last motion is continued.
    ahead_ns : most time by which a pose may be stamped beyond its arrival.
    """

    def __init__(self, first: Pose = STILL, hold_ns: int = _HOLD_NS, ahead_ns: int = _AHEAD_NS) -> None:
        self._first = first
        self._hold_ns = hold_ns
        self._ahead_ns = ahead_ns
        self._known: deque[TimedPose] = deque(maxlen=_KNOWN)
        self._last: PoseMessage | None = None
        self.counters = Counter(dict.fromkeys(_OF_BODY, 0))

    def add(self, message: PoseMessage, arrival_ns: int) -> None:
        """Add a pose that arrived at the scene's time `arrival_ns`, or refuse it; either is counted."""
        if message.t_ns > arrival_ns + self._ahead_ns:
            self.counters[TOO_FAR_AHEAD] += 1
        elif self._is_repetition(message):
            self.counters[REPEATED] += 1
        else:
            self._last = message
            self._insert(message, arrival_ns)

    def restart(self, t_ns: int) -> None:
        """Go back to time `t_ns`: the newest pose without a time of its own holds from there."""
        arrived = [pose for pose in self._known if pose.on_arrival]
        timed = [pose for pose in self._known if not pose.on_arrival and pose.t_ns <= t_ns + self._ahead_ns]
        if arrived and (not timed or timed[-1].t_ns < t_ns):
            timed.append(TimedPose(t_ns, arrived[-1].pose, on_arrival=True))
        self._known = deque(timed, maxlen=_KNOWN)

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        poses = self._known
        if not poses or t_ns < poses[0].t_ns:
            return poses[0].pose if len(poses) == _KNOWN else self._first
        if t_ns > poses[-1].t_ns:
            return self._beyond(t_ns)
        after = next(k for k, pose in enumerate(poses) if pose.t_ns >= t_ns)
        if after > 1 and poses[after].t_ns > poses[after - 1].t_ns + _GOES_ON_NS >= t_ns:
            # Two poses a microsecond apart, with some noise, would send the body far away within a millisecond.
            after -= poses[after - 1].t_ns >= poses[after - 2].t_ns + _GOES_ON_NS
        return poses[0].pose if after == 0 else between(poses[after - 1], poses[after], t_ns)

    def pose_and_motion(self, t_ns: int) -> tuple[Pose, Motion]:
        """Return both from the poses known now; no light frame is counted as late."""
        late = self.counters[LATE_PICTURES]
        pose = LivePoses.pose(self, t_ns)
        self.counters[LATE_PICTURES] = late
        return pose, self.motion(t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns` from the poses known now, see `known_motion`; at rest where it stands still."""
        poses = self._known
        if len(poses) < 2 or t_ns < poses[0].t_ns or t_ns > poses[-1].t_ns + self._hold_ns:
            return AT_REST
        return known_motion(list(poses), t_ns)

    def _is_repetition(self, message: PoseMessage) -> bool:
        """Return whether a pose, or a later one, was there already; otherwise count losses and restarts."""
        if self._last is None:
            return False
        ahead = (message.counter - self._last.counter + (1 << 31)) % (1 << 32) - (1 << 31)
        if -_MOST_OVERTAKEN <= ahead < 0 or message == self._last:
            return True
        if 0 <= ahead <= _MOST_LOST:
            self.counters[LOST] += max(0, ahead - 1)
        else:
            self.counters[RESTARTS] += 1
        return False

    def _insert(self, message: PoseMessage, arrival_ns: int) -> None:
        pose = Pose(np.array(message.position_m), np.array(message.q_world_from_body))
        on_arrival = message.t_ns == NOW
        t_ns = arrival_ns if on_arrival else message.t_ns
        while on_arrival and self._known and self._known[-1].t_ns >= t_ns:
            self._known.pop()
        if self._known and t_ns <= self._known[-1].t_ns:
            self.counters[STALE] += 1
            return
        self._known.append(TimedPose(t_ns, pose, on_arrival))
        self.counters[TAKEN] += 1

    def _beyond(self, t_ns: int) -> Pose:
        newest = self._known[-1]
        if t_ns - newest.t_ns > self._hold_ns:
            self.counters[LATE_PICTURES] += 1
        if len(self._known) < 2:
            return newest.pose
        return between(self._known[-2], newest, min(t_ns, newest.t_ns + self._hold_ns))


def between(before: TimedPose, after: TimedPose, t_ns: int) -> Pose:
    """Return the pose on the straight line and great circle through two; `t_ns` may lie beyond the second."""
    (before_ns, a, _), (after_ns, b, _) = before, after
    x = (t_ns - before_ns) / (after_ns - before_ns)
    place = (1 - x) * a.position_m + x * b.position_m  # exact at both, also beside a place very far away
    place = np.clip(place, -FARTHEST_M / 2, FARTHEST_M / 2)  # two hostile poses may point anywhere
    turn = multiply(b.q_world_from_body, conjugate(a.q_world_from_body))
    part = quaternion_of_vector((x - 1) * rotation_vector(turn))
    return Pose(place, multiply(part, b.q_world_from_body))


def known_motion(poses: Sequence[TimedPose], t_ns: int) -> Motion:
    """Return the motion at `t_ns` between two or more poses with their times, increasing, or beyond the last.

    Velocity and turning are those of the straight line and the great circle. The acceleration is that of the parabola
    through three poses: the two around `t_ns` and the one before, or the next where there is none; 0 with two poses.
    Its error is that of the places times 4 / period^2.
    """
    last = next((k for k, timed in enumerate(poses) if timed.t_ns >= t_ns), len(poses) - 1)
    last = max(last, 1)
    (before_ns, a, _), (after_ns, b, _) = poses[last - 1], poses[last]
    seconds = (after_ns - before_ns) * 1e-9
    turn = rotation_vector(multiply(conjugate(a.q_world_from_body), b.q_world_from_body))
    bend = np.zeros(3)
    if len(poses) > 2:
        (t0, p0, _), (t1, p1, _), (t2, p2, _) = poses[max(0, last - 2) : max(3, last + 1)]
        steeper = (p2.position_m - p1.position_m) / (t2 - t1) - (p1.position_m - p0.position_m) / (t1 - t0)
        bend = 2e18 * steeper / (t2 - t0)
    return Motion((b.position_m - a.position_m) / seconds, bend, turn / seconds)


class SimulatedPath(ComingPoses):
    """A path whose poses come step by step from a program that waits for each step.

    It follows `start` until the first pose has come. Between two poses it is a straight line and a great circle. After
    the newest one the last motion goes on, as rates of change are taken a moment around a light frame. `known` are the
    poses that have come, at most the last 64; a program that goes back sets those of the earlier time.
    """

    def __init__(self, start: Trajectory) -> None:
        self._start = start
        self.span_ns = start.span_ns
        self.known: deque[TimedPose] = deque(maxlen=_KNOWN)

    def add(self, t_ns: int, pose: Pose) -> None:
        """Add the pose at `t_ns`, later than all before; raises TrajectoryError where it is not."""
        if self.known and t_ns <= self.known[-1].t_ns:
            raise TrajectoryError(f"a pose at {t_ns} ns came after the one at {self.known[-1].t_ns} ns")
        self.known.append(TimedPose(t_ns, pose))

    def go_on(self, t0_ns: int, t1_ns: int, pose: Pose | None) -> None:
        """Go from `t0_ns`, where the path is now, to a pose at `t1_ns`; without one rest, or go on with `start`."""
        if pose is not None and not self.known:
            self.add(t0_ns, self._start.pose(t0_ns))
        if self.known:
            self.add(t1_ns, self.known[-1].pose if pose is None else pose)

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        poses = self.known
        if not poses:
            return self._start.pose(t_ns)
        if t_ns <= poses[0].t_ns or len(poses) == 1:
            return poses[0].pose
        after = next((k for k, timed in enumerate(poses) if timed.t_ns >= t_ns), len(poses) - 1)
        return between(poses[after - 1], poses[after], t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns` from the poses known now, see `known_motion`."""
        if not self.known:
            return self._start.motion(t_ns)
        if len(self.known) < 2 or t_ns < self.known[0].t_ns:
            return AT_REST
        return known_motion(list(self.known), t_ns)


@dataclass(frozen=True, eq=False)
class GivenPath:
    """A path of a rig that a program gives, in place of that of `table`; no rig file has it."""

    table: Any
    path: SimulatedPath


_MOST_A_FRAME = 256
_REMEMBERED = 32  # light frames whose lateness is compared
_RESTART_NS = 1_000_000_000  # scenes use instants a few milliseconds before and after a frame's own

_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40  # not named in Python's socket module
_TIMESPEC, _COUNT = struct.Struct("@qq"), struct.Struct("@I")
_ROOM = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)


class SceneClock:
    """The scene's time of instants on a wall clock, from the times at which light frames are drawn.

    A light frame of time t is drawn at the wall's time w = t + offset + lateness, lateness >= 0; so the least of the
    last 32 differences is the offset. No instant is later than the frame that is being drawn, at any pace of the run.
    """

    def __init__(self) -> None:
        self._offsets_ns: deque[int] = deque(maxlen=_REMEMBERED)
        self._picture_ns: int | None = None

    def draw(self, t_ns: int, wall_ns: int) -> bool:
        """Note that the frame of `t_ns` is being drawn; return whether the scene's time went back by a second."""
        went_back = self._picture_ns is not None and t_ns < self._picture_ns - _RESTART_NS
        if went_back:
            self._offsets_ns.clear()
        self._picture_ns = t_ns
        self._offsets_ns.append(wall_ns - t_ns)
        return went_back

    def scene_ns(self, wall_ns: int) -> int:
        """Return the scene's time of an instant before the last `draw`, not below 0."""
        assert self._picture_ns is not None
        return max(0, min(wall_ns - min(self._offsets_ns), self._picture_ns))


class PoseReceiver:
    """A UDP port that receives the poses of numbered bodies; the owner closes it.

    Raises OSError with the remedy where the port is not available.

    Parameters
    ----------
    host, port : address to listen on; port 0 takes any free one.
    allow : addresses and networks whose datagrams are used; empty: all, for a port that only this machine reaches.
    clock : the wall clock that the kernel stamps datagrams with, ns.
    """

    def __init__(
        self, host: str, port: int, allow: Iterable[str] = (), clock: Callable[[], int] = time.time_ns
    ) -> None:
        self.allow, self._clock = frozenset(allow), clock
        self._permits = lru_cache(AllowList(self.allow).permits)
        self._bodies: dict[int, LivePoses] = {}
        self._scene = SceneClock()
        self._picture_ns, self._left = -1, 0
        self.counters = Counter(dict.fromkeys(_OF_PORT, 0))
        self._socket = _listening(host, port)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that it listens on."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    def register(self, body: int, poses: LivePoses) -> None:
        """Give the poses of `body` to `poses` from now on."""
        if body in self._bodies:
            raise TrajectoryError(f"two paths use the live poses of body {body} on port {self.address[1]}")
        self._bodies[body] = poses

    def receive(self, t_ns: int) -> None:
        """Read the datagrams that have come before the light frame of `t_ns`, at most 256."""
        if t_ns != self._picture_ns:
            self._picture_ns, self._left = t_ns, _MOST_A_FRAME
            if self._scene.draw(t_ns, self._clock()):
                for poses in self._bodies.values():
                    poses.restart(t_ns)
        while self._left and self._receive_one():
            self._left -= 1

    def take(self, data: bytes, sender: str, arrival_ns: int) -> None:
        """Use one datagram that arrived at the wall's time `arrival_ns`, or count the reason; after `receive`."""
        if self.allow and not self._permits(sender):
            self.counters[NOT_ALLOWED] += 1
            return
        try:
            message = PoseMessage.parse(data)
        except PoseMessageError:
            self.counters[REFUSED] += 1
            return
        if message.body in self._bodies:
            self._bodies[message.body].add(message, self._scene.scene_ns(arrival_ns))
        else:
            self.counters[UNKNOWN_BODY] += 1

    def close(self) -> None:
        """Stop listening; a second call does nothing."""
        self._socket.close()

    def _receive_one(self) -> bool:
        try:
            data, notes, _, sender = self._socket.recvmsg(POSE_BYTES + 1, _ROOM)
        except BlockingIOError:
            return False
        arrival_ns = self._clock()
        for _, kind, note in notes:
            if kind == _SO_TIMESTAMPNS:
                seconds, ns = _TIMESPEC.unpack(note)
                arrival_ns = seconds * 1_000_000_000 + ns
            elif kind == _SO_RXQ_OVFL:
                (self.counters[DROPPED_BY_SYSTEM],) = _COUNT.unpack(note)
        self.take(data, sender[0], arrival_ns)
        return True


class ReceivedPath(LivePoses):
    """The path of `body`, whose poses a receiver gets; the other parameters are those of `LivePoses`."""

    def __init__(
        self, receiver: PoseReceiver, body: int, first: Pose = STILL, hold_ns: int = _HOLD_NS, ahead_ns: int = _AHEAD_NS
    ) -> None:
        super().__init__(first, hold_ns, ahead_ns)
        self.receiver = receiver
        receiver.register(body, self)

    def pose(self, t_ns: int) -> Pose:
        """Read the poses that have come and return the pose at `t_ns`."""
        self.receiver.receive(t_ns)
        return super().pose(t_ns)


def close_receivers(*paths: Trajectory | None) -> None:
    """Close the ports that some of the paths listen on."""
    for path in paths:
        if isinstance(path, ReceivedPath):
            path.receiver.close()


def live_counts(*paths: Trajectory | None) -> dict[str, int]:
    """Return the counts of all paths with poses from outside, added up; empty where there is none."""
    received = [path for path in paths if isinstance(path, ReceivedPath)]
    receivers = dict.fromkeys(path.receiver for path in received)
    counts = Counter[str]()
    for counters in (*(path.counters for path in received), *(receiver.counters for receiver in receivers)):
        counts.update(counters)
    return dict(counts)


def _listening(host: str, port: int) -> socket.socket:
    udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    udp.setblocking(False)
    for option in (_SO_TIMESTAMPNS, _SO_RXQ_OVFL):
        udp.setsockopt(socket.SOL_SOCKET, option, 1)
    try:
        udp.bind((host, port))
    except OSError as error:
        udp.close()
        raise OSError(
            error.errno,
            f"cannot listen for poses on {host} port {port}: {error.strerror}; stop what holds the port, or give "
            "another one (0 takes any free one)",
        ) from error
    return udp
