"""Poses that come from outside while the run goes on: the closed loop.

One UDP datagram a pose (layout: `firmware_protocol.pose_message`). All that have come are taken in whenever a picture
is to be drawn, so a pose is on the light within one frame. For a picture of time t

    between two known poses     the pose is interpolated: straight line, great circle
    after the newest one        it goes on as it moved last, for at most `hold_ms`; then it stands still, and every
                                picture is counted as late
    before the first one        the pose that the rig gives

A pose that is older than one already there, or not a pose at all, is refused and counted. Time -1 means now: that pose
takes the time of the next picture. Poses of other bodies than this one are left to whoever listens for them.
"""

from __future__ import annotations

import socket
from collections import deque
from dataclasses import dataclass

import numpy as np

from emulator.trajectory.measured import turn_rad
from emulator.trajectory.pose import STILL, Pose, Trajectory, multiply
from firmware_protocol.pose_message import NOW, POSE_BYTES, PoseMessage, PoseMessageError

__all__ = ["Inlet", "LiveCounters", "LivePoses", "close_inlets", "live_counts"]

_KNOWN = 64


@dataclass
class LiveCounters:
    """What came in, and how often it came too late.

    Attributes
    ----------
    taken : poses used.
    refused : datagrams that were no pose.
    stale : poses older than one that was there.
    lost : poses missing by the sender's counter.
    late_pictures : pictures drawn with a pose that had stood still for want of a newer one.
    """

    taken: int = 0
    refused: int = 0
    stale: int = 0
    lost: int = 0
    late_pictures: int = 0


class LivePoses(Trajectory):
    """What is known of a path that is still being flown; fed by `add`.

    Parameters
    ----------
    first : the pose until one comes.
    hold_ns : how long the last motion is carried on.
    """

    def __init__(self, first: Pose = STILL, hold_ns: int = 100_000_000) -> None:
        self._first, self._hold_ns = first, hold_ns
        self._known: deque[tuple[int, Pose]] = deque(maxlen=_KNOWN)
        self._now: Pose | None = None
        self._counter: int | None = None
        self.counters = LiveCounters()

    def add(self, message: PoseMessage) -> None:
        """Take a pose in, or refuse it as stale."""
        if self._counter is not None:
            self.counters.lost += max(0, (message.counter - self._counter - 1) % (1 << 32)) % (1 << 31)
        self._counter = message.counter
        pose = Pose(np.array(message.position_m), np.array(message.q_world_from_body))
        if message.t_ns == NOW:
            self._now = pose
        elif self._known and message.t_ns <= self._known[-1][0]:
            self.counters.stale += 1
            return
        else:
            self._known.append((message.t_ns, pose))
        self.counters.taken += 1

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        if self._now is not None:
            while self._known and self._known[-1][0] >= t_ns:
                self._known.pop()
            self._known.append((t_ns, self._now))
            self._now = None
        known = self._known
        if not known or t_ns < known[0][0]:
            return known[0][1] if known and len(known) == _KNOWN else self._first
        if t_ns > known[-1][0]:
            return self._beyond(t_ns)
        after = next(k for k, (t, _) in enumerate(known) if t >= t_ns)
        return known[0][1] if after == 0 else _between(*known[after - 1], *known[after], t_ns)

    def _beyond(self, t_ns: int) -> Pose:
        t1_ns, newest = self._known[-1]
        if t_ns - t1_ns > self._hold_ns:
            self.counters.late_pictures += 1
        if len(self._known) < 2:
            return newest
        return _between(*self._known[-2], t1_ns, newest, min(t_ns, t1_ns + self._hold_ns))

    @property
    def speed_bound_m_s(self) -> float:
        """Nobody knows."""
        return float("inf")

    @property
    def turn_bound_rad_s(self) -> float:
        """Nobody knows."""
        return float("inf")


class Inlet(Trajectory):
    """Listens on a UDP port for poses of one body; the owner closes it.

    Raises
    ------
    OSError
        The port cannot be had; the message says what to do.
    """

    def __init__(self, host: str, port: int, poses: LivePoses, body: int = 0) -> None:
        self._poses, self._body = poses, body
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            raise OSError(
                error.errno,
                f"cannot listen for poses on {host} port {port}: {error.strerror}; stop what holds the port, or give "
                "another one (0 takes any free one)",
            ) from error

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that it listens on."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def counters(self) -> LiveCounters:
        """What came in."""
        return self._poses.counters

    def pose(self, t_ns: int) -> Pose:
        """Take in what has come and return the pose at `t_ns`."""
        self._receive()
        return self._poses.pose(t_ns)

    def close(self) -> None:
        """Listen no more."""
        self._socket.close()

    @property
    def speed_bound_m_s(self) -> float:
        """Nobody knows."""
        return self._poses.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """Nobody knows."""
        return self._poses.turn_bound_rad_s

    def _receive(self) -> None:
        while True:
            try:
                data = self._socket.recv(POSE_BYTES + 1)
            except BlockingIOError:
                return
            try:
                message = PoseMessage.parse(data)
            except PoseMessageError:
                self.counters.refused += 1
                continue
            if message.body == self._body:
                self._poses.add(message)


def close_inlets(*paths: Trajectory) -> None:
    """Let go of the ports that some of the paths listen on."""
    for path in paths:
        if isinstance(path, Inlet):
            path.close()


def live_counts(*paths: Trajectory) -> dict[str, int]:
    """Return what came in for those of the paths that are flown from outside, added up; empty where none is."""
    inlets = [path.counters for path in paths if isinstance(path, Inlet)]
    names = vars(LiveCounters()) if inlets else ()
    told = {name: "pictures with a late pose" if name == "late_pictures" else f"poses {name}" for name in names}
    return {told[name]: sum(int(vars(counters)[name]) for counters in inlets) for name in names}


def _between(t0_ns: int, a: Pose, t1_ns: int, b: Pose, t_ns: int) -> Pose:
    """Return the pose on the straight line and great circle through two poses; `t_ns` may lie beyond the second."""
    x = (t_ns - t0_ns) / (t1_ns - t0_ns)
    place = a.position_m + x * (b.position_m - a.position_m)
    if turn_rad(a, b) < 1e-9:
        return Pose(place, b.q_world_from_body)
    turn = multiply(b.q_world_from_body, a.q_world_from_body * np.array([1.0, -1.0, -1.0, -1.0]))
    if turn[0] < 0:
        turn = -turn
    half = np.arctan2(np.linalg.norm(turn[1:]), turn[0])
    axis = turn[1:] / np.linalg.norm(turn[1:])
    part = np.concatenate([[np.cos(x * half)], np.sin(x * half) * axis])
    return Pose(place, multiply(part, a.q_world_from_body))
