"""Motion of a node of a model file: a chain of joints, each with tracks of its translation and its rotation.

A track is a function of time through given values, as glTF 2.0 defines it (specification, appendix C):

    linear           translations on straight lines, rotations by slerp on the shorter great circle: a steady turn
    cubic            Hermite curves through given tangents; rotations are made unit quaternions again

Before its first time and after its last a track is constant. At a key of a linear track the velocity jumps. A light's
rate, which takes poses a millisecond to either side, has the mean of both sides there.

A joint's pose is that of all before it, a fixed pose, and then its translation and rotation:

    pose = base * fixed_1 * (translation_1(t), rotation_1(t)) * fixed_2 * ...
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from emulator.trajectory.pose import STILL, Bounds, Pose, Trajectory, instants_between, measured_bounds
from firmware_protocol.events import Floats

_ALMOST_EQUAL = 1 - 1e-12


@dataclass(frozen=True, eq=False)
class Track:
    """Values at times.

    Attributes
    ----------
    times_s : (n,), increasing.
    values : (n, 3) translations in metres, or (n, 4) unit quaternions, scalar first.
    tangents : (n, 2, k) slopes before and after each time, 1/s; None: linear.
    """

    times_s: Floats
    values: Floats
    tangents: Floats | None = None

    def at(self, t_s: float) -> Floats:
        """Return the value at `t_s`, (k,)."""
        times = self.times_s
        if t_s <= times[0] or len(times) == 1:
            return np.asarray(self.values[0])
        if t_s >= times[-1]:
            return np.asarray(self.values[-1])
        k = int(np.searchsorted(times, t_s, "right")) - 1
        length_s = float(times[k + 1] - times[k])
        x = (t_s - float(times[k])) / length_s
        a, b = self.values[k], self.values[k + 1]
        if self.tangents is None:
            return _slerp(a, b, x) if len(a) == 4 else np.asarray(a + x * (b - a))
        start, end = length_s * self.tangents[k, 1], length_s * self.tangents[k + 1, 0]
        value = (1 + 2 * x) * (1 - x) ** 2 * a + x * (1 - x) ** 2 * start
        value = value + x * x * (3 - 2 * x) * b + x * x * (x - 1) * end
        return np.asarray(value / np.linalg.norm(value) if len(a) == 4 else value)


def _slerp(a: Floats, b: Floats, share: float) -> Floats:
    cosine = float(a @ b)
    if cosine < 0:
        b, cosine = -b, -cosine
    if cosine > _ALMOST_EQUAL:
        mixed = a + share * (b - a)
        return np.asarray(mixed / np.linalg.norm(mixed))
    angle = math.acos(cosine)
    return np.asarray((math.sin((1 - share) * angle) * a + math.sin(share * angle) * b) / math.sin(angle))


@dataclass(frozen=True, eq=False)
class Joint:
    """A node that moves.

    Attributes
    ----------
    fixed : its frame in that of the joint before.
    translation, rotation : its motion in this frame.
    """

    fixed: Pose
    translation: Track
    rotation: Track


@dataclass(frozen=True, eq=False)
class JointPath:
    """Parameters of the path of a model's node; no rig writes it.

    Attributes
    ----------
    joints : from the model's frame on.
    period_s : time after which the motion begins again; 0: never.
    base : the pose of the model's frame.
    """

    joints: tuple[Joint, ...]
    period_s: float = 0.0
    base: Pose = STILL


class Jointed(Trajectory):
    """The path of a chain of joints."""

    def __init__(self, p: JointPath) -> None:
        self._p = p
        tracks = [track for joint in p.joints for track in (joint.translation, joint.rotation)]
        times_ns = np.unique(np.concatenate([np.round(track.times_s * 1e9) for track in tracks])).astype(np.int64)
        self.span_ns = 0, round(p.period_s * 1e9) or int(times_ns.max(initial=0))
        self.bounds = measured_bounds(self._once, instants_between(times_ns)) if len(times_ns) > 1 else Bounds()

    def pose(self, t_ns: int) -> Pose:
        """Return the pose of the last joint."""
        period_ns = round(self._p.period_s * 1e9)
        return self._once(int(t_ns) % period_ns if period_ns else int(t_ns))

    def _once(self, t_ns: int) -> Pose:
        pose, t_s = self._p.base, t_ns * 1e-9
        for joint in self._p.joints:
            pose = pose.after(joint.fixed.after(Pose(joint.translation.at(t_s), joint.rotation.at(t_s))))
        return pose
