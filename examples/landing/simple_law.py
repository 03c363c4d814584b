"""A law of thirty lines, to start from:  python fly.py --height 100 --guidance simple_law.py:Law

It brakes the fall and stays upright. docs/landing.md has what it receives and returns, how it is judged, why it lands
in half of its flights, and the steps to a better one.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from pilot import LawInput

GRAVITY_M_S2 = 1.62


class Law:
    """A speed down that falls with the height: its square root at large heights, in proportion near the ground."""

    brake_m_s2, share_1_s, gain_1_s = 0.6, 0.08, 1.0

    def __call__(self, state: LawInput) -> np.ndarray:
        """Return the wanted acceleration (east, north, up), (3,), m/s2, gravity's not included."""
        height_m = max(float(state.position_m[2]), 0.0)
        down_m_s = min(self.share_1_s * height_m, math.sqrt(2 * self.brake_m_s2 * height_m))
        too_fast_m_s = -float(state.velocity_m_s[2]) - down_m_s
        return np.array([0.0, 0.0, GRAVITY_M_S2 + self.gain_1_s * too_fast_m_s])
