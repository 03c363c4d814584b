"""Plain difference of two pictures: AirSim's rule, and the basic one of Ziegler et al. (arXiv 2209.04634).

A pixel fires as often as the change of log light from one picture to the next holds its threshold; there is no filter,
no leak and no reference, so that what a step leaves over is forgotten. Events are spread evenly, the last at the end.
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.other_simulators.rule import Fired, Frame, Rule, each

__all__ = ["FrameDifference"]


class FrameDifference(Rule):
    """The change since the last picture, counted in thresholds."""

    def _fire(self, frame: Frame) -> Fired:
        change = np.where(frame.seen, frame.u1, 0) - np.where(frame.seen, frame.u0, 0)
        on = change > 0
        counts = np.floor(np.abs(change) / np.where(on, self._drawn.on, self._drawn.off)).astype(np.int64)
        pixel, k = each(counts)
        return Fired(pixel, (k + 1) / counts[pixel], on[pixel])
