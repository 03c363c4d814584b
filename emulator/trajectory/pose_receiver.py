"""Reception of poses: one UDP port for the camera and any number of bodies, each datagram with the number of a body.

One datagram a pose (layout: `firmware_protocol.pose_message`). All datagrams that have come are read before a light
frame is drawn, so a pose acts within one frame; at most 256 datagrams a frame, so that a flood cannot delay the run.

A datagram is used only if its sender is allowed, it is a pose, and its body is known; all others are counted. The
kernel stamps each one with the wall clock (`SO_TIMESTAMPNS`) and counts those that it had no room for (`SO_RXQ_OVFL`);
see socket(7). `SceneClock` turns the stamps into the scene's time.
"""

from __future__ import annotations

import socket
import struct
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass

from emulator.trajectory.live import LiveCounters, LivePoses
from emulator.trajectory.motion import Motion
from emulator.trajectory.pose import Pose, Trajectory, TrajectoryError
from firmware_protocol.pose_message import POSE_BYTES, PoseMessage, PoseMessageError

__all__ = ["PoseReceiver", "ReceivedPath", "ReceiverCounters", "SceneClock", "close_receivers", "live_counts"]

_MOST_A_FRAME = 256
_REMEMBERED = 32  # light frames whose lateness is compared
_RESTART_NS = 1_000_000_000  # scenes use instants a few milliseconds before and after a frame's own

_SO_TIMESTAMPNS, _SO_RXQ_OVFL = 35, 40  # not named in Python's socket module
_TIMESPEC, _COUNT = struct.Struct("@qq"), struct.Struct("@I")
_ROOM = socket.CMSG_SPACE(_TIMESPEC.size) + socket.CMSG_SPACE(_COUNT.size)


@dataclass
class ReceiverCounters:
    """Counts of the datagrams at one port that no body took.

    Attributes
    ----------
    refused : datagrams that are no pose.
    not_allowed : datagrams of senders that are not allowed.
    unknown_body : poses of bodies that are not registered.
    dropped_by_system : datagrams that the system had no room for.
    """

    refused: int = 0
    not_allowed: int = 0
    unknown_body: int = 0
    dropped_by_system: int = 0


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

    Parameters
    ----------
    host, port : address to listen on; port 0 takes any free one.
    allow : addresses whose datagrams are used; empty: all, for a port that only this machine reaches.
    clock : the wall clock that the kernel stamps datagrams with, ns.

    Raises
    ------
    OSError
        The port is not available; the message contains the remedy.
    """

    def __init__(
        self, host: str, port: int, allow: Iterable[str] = (), clock: Callable[[], int] = time.time_ns
    ) -> None:
        self._allow, self._clock = frozenset(allow), clock
        self._bodies: dict[int, LivePoses] = {}
        self._scene = SceneClock()
        self._picture_ns, self._left = -1, 0
        self.counters = ReceiverCounters()
        self._socket = _listening(host, port)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port that it listens on."""
        host, port = self._socket.getsockname()
        return str(host), int(port)

    @property
    def allow(self) -> frozenset[str]:
        """Addresses whose datagrams are used."""
        return self._allow

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
        if self._allow and sender not in self._allow:
            self.counters.not_allowed += 1
            return
        try:
            message = PoseMessage.parse(data)
        except PoseMessageError:
            self.counters.refused += 1
            return
        if message.body in self._bodies:
            self._bodies[message.body].add(message, self._scene.scene_ns(arrival_ns))
        else:
            self.counters.unknown_body += 1

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
                (self.counters.dropped_by_system,) = _COUNT.unpack(note)
        self.take(data, sender[0], arrival_ns)
        return True


class ReceivedPath(Trajectory):
    """The path of one body whose poses a receiver gets."""

    def __init__(self, receiver: PoseReceiver, body: int, poses: LivePoses) -> None:
        receiver.register(body, poses)
        self.receiver, self._poses = receiver, poses

    @property
    def counters(self) -> LiveCounters:
        """Counts of this body's poses."""
        return self._poses.counters

    def pose(self, t_ns: int) -> Pose:
        """Read the poses that have come and return the pose at `t_ns`."""
        self.receiver.receive(t_ns)
        return self._poses.pose(t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns` from the poses that have come, see `LivePoses.motion`."""
        return self._poses.motion(t_ns)

    def pose_and_motion(self, t_ns: int) -> tuple[Pose, Motion]:
        """Return both from the poses that have come."""
        return self._poses.pose_and_motion(t_ns)

    @property
    def speed_bound_m_s(self) -> float:
        """Infinite: poses to come are not known."""
        return self._poses.speed_bound_m_s

    @property
    def turn_bound_rad_s(self) -> float:
        """Infinite: poses to come are not known."""
        return self._poses.turn_bound_rad_s


def close_receivers(*paths: Trajectory) -> None:
    """Close the ports that some of the paths listen on."""
    for path in paths:
        if isinstance(path, ReceivedPath):
            path.receiver.close()


_NAMES = {
    "late_pictures": "pictures with a late pose",
    "restarts": "restarts of a pose sender",
    "too_far_ahead": "poses too far ahead",
    "not_allowed": "poses from addresses not allowed",
    "unknown_body": "poses of unknown bodies",
    "dropped_by_system": "poses dropped by the system",
}


def live_counts(*paths: Trajectory) -> dict[str, int]:
    """Return the counts of all paths with poses from outside, added up; empty where there is none."""
    received = [path for path in paths if isinstance(path, ReceivedPath)]
    counters = [*(path.counters for path in received), *{path.receiver: None for path in received}]
    counts: dict[str, int] = {}
    for one in counters:
        values = vars(one.counters if isinstance(one, PoseReceiver) else one)
        for name, value in values.items():
            label = _NAMES.get(name, f"poses {name}")
            counts[label] = counts.get(label, 0) + int(value)
    return counts


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
