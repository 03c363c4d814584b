"""Difference of two frames: AirSim's rule, and the basic one of Ziegler et al. (arXiv 2209.04634).

The number of events is the change of log light between two frames over the threshold, rounded down. There is no filter,
no leak and no reference: the rest of the change is lost. Events are spread evenly, the last at the end of the step.
"""

from __future__ import annotations

import numpy as np

from emulator.sensor.other_simulators.rule import Fired, Frame, Rule, each

__all__ = ["FrameDifference"]


class FrameDifference(Rule):
    """Events by the change of log light since the last frame, in thresholds."""

    def _fire(self, frame: Frame) -> Fired:
        change = np.where(frame.readable, frame.u1, 0) - np.where(frame.readable, frame.u0, 0)
        on = change > 0
        counts = np.floor(np.abs(change) / np.where(on, self._drawn.on, self._drawn.off)).astype(np.int64)
        pixel, k = each(counts)
        return Fired(pixel, (k + 1) / counts[pixel], on[pixel])
