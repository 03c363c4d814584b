"""Thrust from the motion that events show: constant divergence down to a height, then a slow fall to the ground.

    a_up   = D*^2 h + k h (D - D*)  + g          D* = rate of the descent wanted at that height
    a_east = -k h u,  a_north = k h v            (u, v, D) = velocity east, south, down / height

A fixed gain would swing near the ground, where the loop's delay is long beside h / K: here it falls with the height.
The height is never measured. It starts from the value of navigation before the descent (with its error), and falls with
the divergence itself: h' = -D h, D the measured one. Below `final_m` the speed is held, not the divergence.

When no motion is accepted, the last one holds for `hold_s`. After that the vehicle uses dead reckoning: it stands
upright, and its speed of descent is the last one, changed by the accelerations commanded since and by the estimated
error of the engine. This is enough for the last metres over ground without detail, not for a whole descent.

Tilt is kept small. An event reports an edge only after the light has changed by a threshold, so on ground of little
contrast it lags by some pixels. This has no effect while all moves one way; when the vehicle rocks, the lag turns with
the motion and looks like a speed (3 degrees of rocking at 1500 m: errors of 0.01/s, 10 m/s).

`PredictingGuidance` is for a loop whose delay is long or changes, and for wrong motions with a good contrast. The
divergence is that of the middle of the window; the next command acts when it has been decided, sent, and followed
by the engine. In between the vehicle follows the commands sent before:

    h' = -s,   s' = g - a_up + drift        from the middle of the window until the next command acts

so the speed s and the height h at that time can be computed, and only the errors of the model are delayed (a Smith
predictor). The gain is lowered with the time predicted over, so that it stays stable without the model too
(k t < pi/2).

A motion is compared with the one that was predicted for its time, and half of the difference is applied. Late pictures
and lost events make motions that are wrong by half; so does ground without detail near the end, where few events are
left and most of them are noise. Without the comparison two landings of forty braked until the vehicle rose.
"""

from __future__ import annotations

import dataclasses
import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from divergence import Motion
from vehicle import GRAVITY_M_S2

_LEAST_M = 0.5  # a height below it is not used
_LEARNING_1_S = 0.05  # at which the engine's error is estimated from each turn


@dataclass(frozen=True)
class Law:
    """Parameters of the descent.

    Attributes
    ----------
    divergence_1_s : wanted, where thrust allows it.
    most_up_m_s2 : acceleration (without gravity's) that the descent may need; slower divergence higher up.
    gain_1_s, sideways_1_s : k of the descent and of the two horizontal axes, which wait for the vehicle to turn.
    most_tilt, tilt_m : of the acceleration, horizontal over vertical, up to this height; above it in proportion less.
    most_jump, most_jump_1_s : from one motion to the next, of its divergence and beside it; a larger one is refused.
    hold_s : time for which the last motion holds when none is measured.
    final_m, final_m_s : height below which a speed is held, and the speed.
    window_px : motion at the edge of the picture within one window of events.
    window_s : least and most length of a window.
    """

    divergence_1_s: float = 0.08
    most_up_m_s2: float = 1.2
    gain_1_s: float = 1.0
    sideways_1_s: float = 0.15
    most_tilt: float = 0.03
    tilt_m: float = 250.0
    most_jump: float = 0.3
    most_jump_1_s: float = 0.01
    final_m: float = 8.0
    final_m_s: float = 0.5
    window_px: float = 12.0
    window_s: tuple[float, float] = (0.2, 4.0)
    hold_s: float = 1.0

    def wanted_1_s(self, height_m: float) -> float:
        """Return the divergence wanted at a height."""
        fastest = math.sqrt(self.most_up_m_s2 / max(height_m, 1e-3))
        return min(self.divergence_1_s, fastest) if height_m > self.final_m else self.final_m_s / max(height_m, 1.0)


class Guidance:
    """Turns motions into accelerations.

    Parameters
    ----------
    law : of the descent.
    height_m, velocity_m_s : from navigation, at the start; (east, north, up).
    edge_px : focal length times the edge of the picture, normalised: speed of the edge at a divergence of 1/s, px/s.
    """

    def __init__(self, law: Law, height_m: float, velocity_m_s: npt.NDArray[np.float64], edge_px: float) -> None:
        self._law, self._edge_px = law, edge_px
        self.height_m = height_m
        east, north, up = velocity_m_s.tolist()
        self.motion = Motion(east / height_m, -north / height_m, -up / height_m, math.inf, 0.0, 0)
        self._believed_s = 0.0
        self._sink_m_s = -up
        self._up_m_s2 = GRAVITY_M_S2
        self._drift_m_s2 = 0.0  # by which the vehicle sinks faster than commanded

    def begin(self, now_s: float) -> None:
        """Begin the descent now, not at time 0: until a motion is measured, that of navigation holds from here."""
        self.motion = dataclasses.replace(self.motion, at_s=now_s)
        self._believed_s = now_s

    @property
    def window_s(self) -> float:
        """Length of the next window of events."""
        seen = self.motion
        speed_px_s = self._edge_px * max(abs(seen.down), math.hypot(seen.east, seen.south), 1e-3)
        return float(np.clip(self._law.window_px / speed_px_s, *self._law.window_s))

    def lost(self, now_s: float) -> bool:
        """Return True when the last motion is too old to hold."""
        return now_s - self._believed_s > self._law.hold_s

    def take(self, motion: Motion, now_s: float) -> None:
        """Take the motion of the newest window; one that is refused leaves the last motion unchanged.

        The longer none was accepted, the more a motion may differ from dead reckoning.
        """
        law, last = self._law, self.motion
        down = self._sink_m_s / self.height_m if self.lost(now_s) else last.down
        reach = law.most_jump * abs(down) + law.most_jump_1_s * (1 + now_s - self._believed_s)
        jumps = (motion.down - down, motion.east - last.east, motion.south - last.south)
        if motion.reliable and max(map(abs, jumps)) <= reach:
            self.motion, self._believed_s = motion, now_s

    def command_m_s2(self, now_s: float, period_s: float) -> npt.NDArray[np.float64]:
        """Return the acceleration wanted from `now_s` on, (east, north, up), gravity's not included."""
        law = self._law
        reckoned_m_s = self._sink_m_s + (self._drift_m_s2 - self._up_m_s2 + GRAVITY_M_S2) * period_s
        down = reckoned_m_s / self.height_m if self.lost(now_s) else self._seen(now_s)
        self._sink_m_s = down * self.height_m
        self._drift_m_s2 += _LEARNING_1_S * (self._sink_m_s - reckoned_m_s) * (period_s > 0)
        self.height_m = max(self.height_m * math.exp(-down * period_s), _LEAST_M)
        wanted, gain = law.wanted_1_s(self.height_m), self._gain_1_s(now_s) * self.height_m
        steady = wanted**2 * self.height_m * (self.height_m > law.final_m)
        self._up_m_s2 = steady + gain * (down - wanted) + GRAVITY_M_S2
        return np.array([*self._sideways_m_s2(now_s), self._up_m_s2])

    def _gain_1_s(self, now_s: float) -> float:
        return self._law.gain_1_s

    def _seen(self, now_s: float) -> float:
        """Return the divergence of now: the speed is that in the middle of the window, the ground is nearer."""
        delay_s = max(now_s - self.motion.at_s, 0.0)
        return self.motion.down / max(1 - self.motion.down * delay_s, 0.5)

    def _sideways_m_s2(self, now_s: float) -> npt.NDArray[np.float64]:
        law, seen = self._law, self.motion
        if self.lost(now_s):
            return np.zeros(2)
        sideways = law.sideways_1_s * self.height_m * np.array([-seen.east, seen.south])
        tilt = law.most_tilt * min(1.0, law.tilt_m / self.height_m)
        return sideways * min(1.0, tilt * max(self._up_m_s2, 0.0) / max(float(np.hypot(*sideways)), 1e-9))


_STEP_S = 0.05
_KEPT = 100
_GAIN_DELAY = 0.8  # gain times delay, of pi / 2
_ENGINE_S = 0.1
_LEARNING = 0.2
_WEIGHT = 0.5  # of a motion beside the prediction
# Of a motion beside the prediction; the second grows with the time since one was accepted.
_MOST_JUMP, _MOST_JUMP_1_S = 0.15, 0.004


class _Sent(NamedTuple):
    """A command: when it acts, its acceleration upwards, and the height at its turn."""

    acts_s: float
    up_m_s2: float
    turn_s: float
    height_m: float


class PredictingGuidance(Guidance):
    """The law of `Guidance` for the time at which the next command acts.

    Parameters
    ----------
    delay_s : time from a turn until its command acts, first estimate; `took` corrects it. The others: see Guidance.
    """

    def __init__(self, *args: object, delay_s: float = 0.1) -> None:
        super().__init__(*args)  # type: ignore[arg-type]
        self._sent: deque[_Sent] = deque(maxlen=_KEPT)
        self._delay_s = delay_s
        self._now_s = 0.0

    def took(self, seconds: float) -> None:
        """Report the time of the last command from its turn until it was sent."""
        self._delay_s += _LEARNING * (seconds - self._delay_s)

    def take(self, motion: Motion, now_s: float) -> None:
        """Take the motion of the newest window, if it agrees with the prediction."""
        expected = self.expected(motion.at_s)
        reach = _MOST_JUMP * abs(expected) + _MOST_JUMP_1_S * (1 + now_s - self._believed_s)
        aside = max(abs(motion.east - self.motion.east), abs(motion.south - self.motion.south))
        if motion.reliable and abs(motion.down - expected) <= reach and aside <= reach + self._law.most_jump_1_s:
            down = expected + _WEIGHT * (motion.down - expected)
            self.motion, self._believed_s = replace(motion, down=down), now_s

    @property
    def window_s(self) -> float:
        """Length of the next window of events; of the motion that is predicted, not of the last one measured."""
        down = max(abs(self._seen(self._now_s)), 1e-3)
        seen = self.motion
        speed_px_s = self._edge_px * max(down, float(np.hypot(seen.east, seen.south)))
        return float(np.clip(self._law.window_px / speed_px_s, *self._law.window_s))

    def command_m_s2(self, now_s: float, period_s: float) -> npt.NDArray[np.float64]:
        """Return the acceleration wanted when the command acts, (east, north, up), gravity's not included."""
        self._now_s = now_s
        command = super().command_m_s2(now_s, period_s)
        acts_s = now_s + self._delay_s + _ENGINE_S
        self._sent.append(_Sent(acts_s, float(command[2]), now_s, self.height_m))
        return command

    def _gain_1_s(self, now_s: float) -> float:
        delay_s = now_s + self._delay_s + _ENGINE_S - self.motion.at_s
        return min(self._law.gain_1_s, _GAIN_DELAY / max(delay_s, 1e-3))

    def _seen(self, now_s: float) -> float:
        """Return the divergence of the time at which the next command acts."""
        return self.expected(now_s + self._delay_s + _ENGINE_S)

    def expected(self, end_s: float) -> float:
        """Return the divergence that is predicted for a time from the last motion on."""
        t_s = self.motion.at_s
        height_m = self._height_m(t_s)
        sink_m_s = self.motion.down * height_m
        while t_s < end_s:
            step_s = min(_STEP_S, end_s - t_s)
            sink_m_s += (GRAVITY_M_S2 - self._up(t_s) + self._drift_m_s2) * step_s
            height_m = max(height_m - sink_m_s * step_s, _LEAST_M)
            t_s += step_s
        return sink_m_s / height_m

    def _height_m(self, t_s: float) -> float:
        """Return the height that was reckoned for a time."""
        if not self._sent:
            return self.height_m
        times, heights = zip(*((one.turn_s, one.height_m) for one in self._sent), strict=True)
        return float(np.interp(t_s, times, heights))

    def _up(self, t_s: float) -> float:
        """Return the acceleration of the command that acted at a time."""
        acting = [one.up_m_s2 for one in self._sent if one.acts_s <= t_s]
        return acting[-1] if acting else GRAVITY_M_S2
