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
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from divergence import Motion
from vehicle import GRAVITY_M_S2

__all__ = ["Guidance", "Law"]

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
