"""Poses of one body that come from outside while the run goes on: the closed loop.

The pose of a light frame of time t:

    between two known poses     the pose is interpolated: straight line, great circle
    after the newest one        the last motion goes on for at most `hold_ns`; then the body is at rest, and every
                                light frame is counted as late
    before the first one        the pose that the rig gives

A pose with a time is refused as stale when it is not newer than the newest one, and as too far ahead when it is stamped
more than `ahead_ns` beyond its arrival: otherwise one wrong time would make all later poses stale. A pose for now (time
-1) holds from its arrival, and replaces all poses that are stamped later.

The sender's counter is compared as a signed difference of 32 bits to the last one: 2 to 65 536 more is a loss, 1 to 64
less is a pose that others overtook, and is refused, as is the same pose again; any other jump is a restarted sender.
Poses of a sender that does not count (other poses with the same counter) are used.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from emulator.geometry.attitude import Vector, conjugate, multiply, quaternion_of_vector
from emulator.trajectory.motion import AT_REST, Motion, rotation_vector
from emulator.trajectory.pose import FARTHEST_M, STILL, Pose, Trajectory
from firmware_protocol.pose_message import NOW, PoseMessage

__all__ = ["LiveCounters", "LivePoses", "between", "known_motion"]

_KNOWN = 64
_MOST_LOST = 1 << 16
_MOST_OVERTAKEN = 64


@dataclass
class LiveCounters:
    """Counts of the poses of one body.

    Attributes
    ----------
    taken : poses used.
    stale : poses not newer than one that was there.
    too_far_ahead : poses stamped too far beyond their arrival, refused.
    repeated : duplicates and poses that others overtook, refused.
    lost : poses missing by the sender's counter.
    restarts : jumps of the counter that are neither a loss nor a repetition.
    late_pictures : pictures drawn with a pose that had stood still for want of a newer one.
    """

    taken: int = 0
    stale: int = 0
    too_far_ahead: int = 0
    repeated: int = 0
    lost: int = 0
    restarts: int = 0
    late_pictures: int = 0


@dataclass(frozen=True, eq=False)
class _Known:
    """A pose and its time; `on_arrival`: the sender gave no time."""

    t_ns: int
    pose: Pose
    on_arrival: bool

    @property
    def at(self) -> tuple[int, Pose]:
        """Time and pose."""
        return self.t_ns, self.pose


class LivePoses(Trajectory):
    """A path whose poses are still coming; `add` gives them.

    Parameters
    ----------
    first : the pose until one comes.
    hold_ns : time for which the last motion is continued.
    ahead_ns : most time by which a pose may be stamped beyond its arrival.
    """

    def __init__(self, first: Pose = STILL, hold_ns: int = 100_000_000, ahead_ns: int = 1_000_000_000) -> None:
        self._first, self._hold_ns, self._ahead_ns = first, hold_ns, ahead_ns
        self._known: deque[_Known] = deque(maxlen=_KNOWN)
        self._last: PoseMessage | None = None
        self.counters = LiveCounters()

    def add(self, message: PoseMessage, arrival_ns: int) -> None:
        """Add a pose that arrived at the scene's time `arrival_ns`, or refuse it; either is counted."""
        if message.t_ns > arrival_ns + self._ahead_ns:
            self.counters.too_far_ahead += 1
        elif self._is_repetition(message):
            self.counters.repeated += 1
        else:
            self._last = message
            self._insert(message, arrival_ns)

    def restart(self, t_ns: int) -> None:
        """Go back to time `t_ns`: the newest pose without a time of its own holds from there."""
        arrived = [known for known in self._known if known.on_arrival]
        timed = [known for known in self._known if not known.on_arrival and known.t_ns <= t_ns + self._ahead_ns]
        if arrived and (not timed or timed[-1].t_ns < t_ns):
            timed.append(_Known(t_ns, arrived[-1].pose, on_arrival=True))
        self._known = deque(timed, maxlen=_KNOWN)

    def pose(self, t_ns: int) -> Pose:
        """Return the pose at `t_ns`, as far as it is known by now."""
        known = self._known
        if not known or t_ns < known[0].t_ns:
            return known[0].pose if len(known) == _KNOWN else self._first
        if t_ns > known[-1].t_ns:
            return self._beyond(t_ns)
        after = next(k for k, one in enumerate(known) if one.t_ns >= t_ns)
        return known[0].pose if after == 0 else between(known[after - 1].at, known[after].at, t_ns)

    def pose_and_motion(self, t_ns: int) -> tuple[Pose, Motion]:
        """Return both from the poses known now; no light frame is counted as late."""
        late = self.counters.late_pictures
        pose = self.pose(t_ns)
        self.counters.late_pictures = late
        return pose, self.motion(t_ns)

    def motion(self, t_ns: int) -> Motion:
        """Return the motion at `t_ns` from the poses known now, see `known_motion`; at rest where it stands still."""
        known = [one.at for one in self._known]
        if len(known) < 2 or t_ns < known[0][0] or t_ns > known[-1][0] + self._hold_ns:
            return AT_REST
        return known_motion(known, t_ns)

    @property
    def speed_bound_m_s(self) -> float:
        """Infinite: poses to come are not known."""
        return float("inf")

    @property
    def turn_bound_rad_s(self) -> float:
        """Infinite: poses to come are not known."""
        return float("inf")

    def _is_repetition(self, message: PoseMessage) -> bool:
        """Return whether a pose, or a later one, was there already; otherwise count losses and restarts."""
        if self._last is None:
            return False
        ahead = (message.counter - self._last.counter + (1 << 31)) % (1 << 32) - (1 << 31)
        if -_MOST_OVERTAKEN <= ahead < 0 or message == self._last:
            return True
        if 0 <= ahead <= _MOST_LOST:
            self.counters.lost += max(0, ahead - 1)
        else:
            self.counters.restarts += 1
        return False

    def _insert(self, message: PoseMessage, arrival_ns: int) -> None:
        pose = Pose(np.array(message.position_m), np.array(message.q_world_from_body))
        on_arrival = message.t_ns == NOW
        t_ns = arrival_ns if on_arrival else message.t_ns
        while on_arrival and self._known and self._known[-1].t_ns >= t_ns:
            self._known.pop()
        if self._known and t_ns <= self._known[-1].t_ns:
            self.counters.stale += 1
            return
        self._known.append(_Known(t_ns, pose, on_arrival))
        self.counters.taken += 1

    def _beyond(self, t_ns: int) -> Pose:
        newest = self._known[-1]
        if t_ns - newest.t_ns > self._hold_ns:
            self.counters.late_pictures += 1
        if len(self._known) < 2:
            return newest.pose
        return between(self._known[-2].at, newest.at, min(t_ns, newest.t_ns + self._hold_ns))


def between(before: tuple[int, Pose], after: tuple[int, Pose], t_ns: int) -> Pose:
    """Return the pose on the straight line and great circle through two, each with its time in ns.

    `t_ns` may lie beyond the second.
    """
    (before_ns, a), (after_ns, b) = before, after
    x = (t_ns - before_ns) / (after_ns - before_ns)
    place = (1 - x) * a.position_m + x * b.position_m  # exact at both, also beside a place very far away
    place = np.clip(place, -FARTHEST_M / 2, FARTHEST_M / 2)  # two hostile poses may point anywhere
    turn = multiply(b.q_world_from_body, conjugate(a.q_world_from_body))
    part = quaternion_of_vector((x - 1) * rotation_vector(turn))
    return Pose(place, multiply(part, b.q_world_from_body))


def known_motion(known: Sequence[tuple[int, Pose]], t_ns: int) -> Motion:
    """Return the motion at `t_ns` between two or more poses with their times, increasing, or beyond the last.

    Velocity and turning are those of the straight line and the great circle. The acceleration is that of the parabola
    through three poses: the two around `t_ns` and the one before, or the next where there is none; 0 with two poses.
    Its error is that of the places times 4 / period^2.
    """
    last = next((k for k, (at_ns, _) in enumerate(known) if at_ns >= t_ns), len(known) - 1)
    last = max(last, 1)
    (before_ns, a), (after_ns, b) = known[last - 1], known[last]
    seconds = (after_ns - before_ns) * 1e-9
    turn = rotation_vector(multiply(conjugate(a.q_world_from_body), b.q_world_from_body))
    bend = _second_derivative(known[max(0, last - 2) : max(3, last + 1)])
    return Motion((b.position_m - a.position_m) / seconds, bend, turn / seconds)


def _second_derivative(known: Sequence[tuple[int, Pose]]) -> Vector:
    """Return the second derivative of the parabola through three places, (3,); 0 for fewer."""
    if len(known) < 3:
        return np.zeros(3)
    (t0, a), (t1, b), (t2, c) = known
    first = (b.position_m - a.position_m) / (t1 - t0)
    second = (c.position_m - b.position_m) / (t2 - t1)
    return np.asarray(2e18 * (second - first) / (t2 - t0))
