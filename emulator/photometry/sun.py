"""The Sun, the Earth seen from the Moon, and the units of light.

All light is counted in the band that a silicon pixel and an eye share, 400 to 700 nm. There sunlight at 1 au is

    530 W/m2        133 600 lx        so 252 lm of sunlight a watt

(integrals of the solar spectrum; the total over all wavelengths is 1361 W/m2). Earthlight on the Moon under a full
Earth is about 15 lx, 0.06 W/m2 (Glenar et al. 2019 give 0.15 W/m2 over all wavelengths, half of it heat). Seen from
1 au the Sun's radius is 0.2666 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["EARTHLIGHT_W_M2", "LUMENS_A_WATT", "SUN_W_M2", "Sun"]

SUN_W_M2 = 530.0
LUMENS_A_WATT = 133_600.0 / SUN_W_M2
EARTHLIGHT_W_M2 = 0.06
_RADIUS_DEG = 0.2666


@dataclass(frozen=True)
class Sun:
    """Where the Sun stands, and how far.

    Attributes
    ----------
    direction
        Towards the Sun in the world; need not be of unit length.
    distance_au
        From the Sun, astronomical units.
    """

    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    distance_au: float = 1.0

    def __post_init__(self) -> None:
        if not any(self.direction) or not all(map(math.isfinite, self.direction)):
            raise ValueError(f"direction is {self.direction}: it must be finite and point somewhere")
        if not 0.01 <= self.distance_au <= 1000:
            raise ValueError(f"distance_au is {self.distance_au}: it must be 0.01 to 1000")

    @property
    def irradiance_w_m2(self) -> float:
        """On a surface that faces the Sun, 400 to 700 nm."""
        return SUN_W_M2 / self.distance_au**2

    @property
    def radius_rad(self) -> float:
        """Half the angle that the Sun's disc spans."""
        return math.radians(_RADIUS_DEG) / self.distance_au
