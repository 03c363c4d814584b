"""Gravity at a place of the world: the same everywhere, or that of a point mass at the origin."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from emulator.geometry.attitude import Vector

__all__ = ["EARTH_IN_THE_PICTURE", "MOON_BELOW", "STANDARD_GRAVITY_M_S2", "WEIGHTLESS", "Gravity"]

STANDARD_GRAVITY_M_S2 = 9.80665
"""1 g: the unit of accelerometers, by definition (CGPM 1901)."""


@dataclass(frozen=True, eq=False)
class Gravity:
    """A field of gravity.

    Attributes
    ----------
    uniform_m_s2 : (3,), in the world.
    gm_m3_s2 : of a point mass at the origin; 0: none.
    """

    uniform_m_s2: Vector = field(default_factory=lambda: np.zeros(3))
    gm_m3_s2: float = 0.0

    def at(self, place_m: Vector) -> Vector:
        """Return the acceleration of free fall at a place, (3,) m/s2."""
        if not self.gm_m3_s2:
            return self.uniform_m_s2
        distance_m = float(np.linalg.norm(place_m))
        if not distance_m:
            return self.uniform_m_s2
        return np.asarray(self.uniform_m_s2 - self.gm_m3_s2 / distance_m**3 * place_m)


WEIGHTLESS = Gravity()
MOON_BELOW = Gravity(np.array([0.0, 0.0, -1.62]))
"""The Moon's mean surface gravity, in a world with z up."""
EARTH_IN_THE_PICTURE = Gravity(np.array([0.0, STANDARD_GRAVITY_M_S2, 0.0]))
"""1 g downwards in the picture of a camera at rest with the world's axes."""
