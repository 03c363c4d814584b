"""Guidance that predicts, for a loop whose delay is long or changes, and for wrong motions with a good contrast.

The divergence is that of the middle of the window; the next command acts when it has been decided, sent, and followed
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

from collections import deque
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from divergence import Motion
from guidance import Guidance
from vehicle import GRAVITY_M_S2

__all__ = ["PredictingGuidance"]

_STEP_S = 0.05
_KEPT = 100
_GAIN_DELAY = 0.8  # gain times delay, of pi / 2
_ENGINE_S = 0.1
_LEARNING = 0.2
_LEAST_M = 0.5
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
