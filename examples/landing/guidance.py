"""Guidance with a given attitude: constant divergence down to a height, then a slow fall to the ground.

    a_up   = D*^2 h + k h (D - D*)  + g          D* = rate of the descent wanted at that height
    a_east = -k h u,  a_north = k h v            (u, v, D) = velocity east, south, down / height

A fixed gain would swing near the ground, where the loop's delay is long beside h / K: here it falls with the height.
The height is never measured. It starts from the value of navigation before the descent, and falls with the divergence:
h' = -D h. Below 8 m the speed is held, not the divergence.

The divergence is that of the middle of the window; the next command acts when it has been decided, sent, and followed
by the engine. In between the vehicle follows the commands sent before: h' = -s, s' = g - a_up + drift. So h and s can
be computed for that time, and only the errors of the model are delayed (a Smith predictor). The gain is lowered with
the time predicted over, so that it stays stable without the model too (k t < pi/2).

A motion is compared with the one that was predicted for its time, and half of the difference is applied: late light
frames, lost events and ground without detail make motions that are wrong by half, with a good contrast.

When no motion is accepted, the last one holds for a second. After that the vehicle uses dead reckoning: it stands
upright, and its speed is the last one, changed by the commands since and by the estimated error of the engine.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace

import numpy as np
from divergence import Motion
from frames import ATTITUDE, nearest_number, unpack_attitude
from vehicle import GRAVITY_M_S2, NO_TURN, Vector

DIVERGENCE_1_S, FASTEST_M_S2 = 0.08, 1.2  # wanted; less at heights where it needs more than this acceleration
FINAL_M, FINAL_M_S = 8.0, 0.5  # a height below which a speed is held
GAIN_1_S = 1.0
EDGE_PX = 173.0  # focal length times the edge of the picture, normalised
WINDOW_PX, WINDOW_S = 12.0, (0.2, 4.0)  # motion at the edge within a window of events; its least and greatest length
ENGINE_S = 0.1

_SIDEWAYS_1_S = 0.15  # gain of the two horizontal axes, which wait for the vehicle to turn
_MOST_TILT, _TILT_M = 0.03, 250.0  # horizontal over vertical acceleration up to a height, above it in proportion less:
#   an event lags behind its edge by some pixels, and while the vehicle rocks this lag looks like a speed
_HOLD_S = 1.0
_LEAST_M = 0.5
_DRIFT_1_S, _DELAY_SHARE = 0.05, 0.2  # at which the errors of engine and delay are learned
_GAIN_DELAY = 0.8  # gain times delay, of pi / 2
_STEP_S = 0.05
_WEIGHT = 0.5  # of a motion beside the prediction
# Largest difference of a motion from the prediction; the second grows with the time since one was accepted.
_MOST_JUMP, _MOST_JUMP_1_S, _MOST_ASIDE_1_S = 0.15, 0.004, 0.01


def wanted_1_s(height_m: float) -> float:
    """Return the divergence wanted at a height."""
    fastest = math.sqrt(FASTEST_M_S2 / max(height_m, 1e-3))
    return min(DIVERGENCE_1_S, fastest) if height_m > FINAL_M else FINAL_M_S / max(height_m, 1.0)


def window_s(down_1_s: float, east_1_s: float, south_1_s: float) -> float:
    """Return the length of a window of events in which the edge moves by WINDOW_PX."""
    speed_px_s = EDGE_PX * max(abs(down_1_s), math.hypot(east_1_s, south_1_s), 1e-3)
    return float(np.clip(WINDOW_PX / speed_px_s, *WINDOW_S))


@dataclass
class Guidance:
    """Turns motions into accelerations, predicted for the time at which the next command acts."""

    height_m: float  # from navigation, at the start; later reckoned
    velocity_m_s: Vector  # the same, (east, north, up)
    delay_s: float = 0.1  # from a turn until its command acts, first estimate; `took` corrects it
    attitude_s: float = 0.04  # between two numbers of attitudes
    uses_events = True

    def __post_init__(self) -> None:
        east, north, up = self.velocity_m_s.tolist()
        height_m = self.height_m
        self.motion = Motion(east / height_m, -north / height_m, -up / height_m, math.inf, 0.0, 0)
        self._attitudes = deque([(-2.0, NO_TURN), (-1.0, NO_TURN)], maxlen=200)  # upright, before the first one comes
        # Of each command: the time at which it acts, its acceleration upwards, time and height of its turn.
        self._sent: deque[tuple[float, float, float, float]] = deque(maxlen=100)
        self._accepted_s = self._now_s = 0.0
        self.begins_s = -math.inf  # events before it do not count
        self._sink_m_s = -up
        self._up_m_s2 = GRAVITY_M_S2
        self._drift_m_s2 = 0.0  # by which the vehicle sinks faster than commanded

    def begin(self, now_s: float) -> None:
        """Begin the descent now, not at time 0: until a motion is measured, that of navigation holds from here."""
        self.motion = replace(self.motion, at_s=now_s)
        self._accepted_s = self.begins_s = now_s

    def take_frame(self, identifier: int, data: bytes) -> None:
        """Take a frame of the bus: an attitude."""
        if identifier == ATTITUDE:
            q, number = unpack_attitude(data)
            newest = round(max(self._attitudes[-1][0], 0.0) / self.attitude_s)
            self._attitudes.append((nearest_number(number, newest) * self.attitude_s, q))

    def complete(self, now_s: float) -> bool:
        """Return True when the attitudes until a time have come."""
        return self._attitudes[-1][0] >= now_s - 1e-6

    def attitudes(self, since_s: float) -> list[tuple[float, Vector]]:
        """Return times, s, and attitudes, world from body, those since a time among them."""
        return list(self._attitudes)

    def guess(self, at_s: float) -> Motion:
        """Return the motion at which the estimator begins: the last one."""
        return self.motion

    def window_s(self, now_s: float) -> float:
        """Return the length of the next window of events, by the motion predicted for the last command."""
        return window_s(self._seen(self._now_s), self.motion.east, self.motion.south)

    def take_motion(self, motion: Motion, now_s: float, length_s: float) -> None:
        """Take the motion of the newest window, if it agrees with the prediction."""
        expected = self.expected(motion.at_s)
        most = _MOST_JUMP * abs(expected) + _MOST_JUMP_1_S * (1 + now_s - self._accepted_s)
        aside = max(abs(motion.east - self.motion.east), abs(motion.south - self.motion.south))
        if motion.reliable and abs(motion.down - expected) <= most and aside <= most + _MOST_ASIDE_1_S:
            down = expected + _WEIGHT * (motion.down - expected)
            self.motion, self._accepted_s = replace(motion, down=down), now_s

    def command_m_s2(self, now_s: float, period_s: float) -> Vector:
        """Return the acceleration wanted when the command acts, (east, north, up), gravity's not included."""
        self._now_s = now_s
        reckoned_m_s = self._sink_m_s + (self._drift_m_s2 - self._up_m_s2 + GRAVITY_M_S2) * period_s
        down = reckoned_m_s / self.height_m if self.lost(now_s) else self._seen(now_s)
        self._sink_m_s = down * self.height_m
        self._drift_m_s2 += _DRIFT_1_S * (self._sink_m_s - reckoned_m_s) * (period_s > 0)
        self.height_m = max(self.height_m * math.exp(-down * period_s), _LEAST_M)
        wanted, gain = wanted_1_s(self.height_m), self._gain_1_s(now_s) * self.height_m
        steady = wanted**2 * self.height_m * (self.height_m > FINAL_M)
        self._up_m_s2 = steady + gain * (down - wanted) + GRAVITY_M_S2
        acts_s = now_s + self.delay_s + ENGINE_S
        self._sent.append((acts_s, self._up_m_s2, now_s, self.height_m))
        return np.array([*self._sideways_m_s2(now_s), self._up_m_s2])

    def took(self, seconds: float) -> None:
        """Report the time of the last command from its turn until it was sent."""
        self.delay_s += _DELAY_SHARE * (seconds - self.delay_s)

    def lost(self, now_s: float) -> bool:
        """Return True when the last motion is too old to hold."""
        return now_s - self._accepted_s > _HOLD_S

    def row(self, now_s: float) -> dict[str, object]:
        """Return what belongs into the log of a turn."""
        return self.motion.row() | {"height_m": self.height_m, "lost": self.lost(now_s)}

    def expected(self, end_s: float) -> float:
        """Return the divergence that is predicted for a time from the last motion on."""
        t_s, height_m = self.motion.at_s, self.height_m
        if self._sent:
            _, _, turns_s, heights_m = zip(*self._sent, strict=True)
            height_m = float(np.interp(t_s, turns_s, heights_m))
        sink_m_s = self.motion.down * height_m
        while t_s < end_s:
            step_s = min(_STEP_S, end_s - t_s)
            acting = [up_m_s2 for acts_s, up_m_s2, _, _ in self._sent if acts_s <= t_s] or [GRAVITY_M_S2]
            sink_m_s += (GRAVITY_M_S2 - acting[-1] + self._drift_m_s2) * step_s
            height_m = max(height_m - sink_m_s * step_s, _LEAST_M)
            t_s += step_s
        return sink_m_s / height_m

    def _seen(self, now_s: float) -> float:
        """Return the divergence of the time at which the next command acts."""
        return self.expected(now_s + self.delay_s + ENGINE_S)

    def _gain_1_s(self, now_s: float) -> float:
        delay_s = now_s + self.delay_s + ENGINE_S - self.motion.at_s
        return min(GAIN_1_S, _GAIN_DELAY / max(delay_s, 1e-3))

    def _sideways_m_s2(self, now_s: float) -> Vector:
        if self.lost(now_s):
            return np.zeros(2)
        sideways = _SIDEWAYS_1_S * self.height_m * np.array([-self.motion.east, self.motion.south])
        tilt = _MOST_TILT * min(1.0, _TILT_M / self.height_m)
        return sideways * min(1.0, tilt * max(self._up_m_s2, 0.0) / max(float(np.hypot(*sideways)), 1e-9))
