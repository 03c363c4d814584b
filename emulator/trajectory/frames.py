"""Names of reference frames in CCSDS files: which ones stand for the world.

A frame stands for the world when its axes are those of the sky or of a planet. Names are compared without case, spaces,
hyphens and underscores. Source: the SANA registry of celestial body reference frames, and SPICE's names (J2000, IAU_*).
Axes of ICRF, GCRF, EME2000 and J2000 differ by less than 0.1 seconds of arc and count as the same.
"""

from __future__ import annotations

import re

__all__ = ["axes_of", "world_is_a"]

_CELESTIAL = re.compile(
    r"(ICRF|MCI|B1950|FK[45]|TEME(OFDATE|OFEPOCH)?|TOD|MOD|MOE|TOE|TOR|TRUEECLIPTIC|"
    r"(MEAN)?ECLIPTIC(J2000)?|ECLIPJ2000|J2000ECLIPTIC|ALIGN(CB|EARTH)|UVWGOINERTIAL|GALACTIC|"
    r"ITRF\d*|DTRF\d*|CIRS|TIRS|GTOD|TDR|PEF|EFG|WGS84|FIXED(CB|EARTH)|MOON(ME|MEIAU|PA).*|IAU.+)$"
)
_SAME_AXES = re.compile(r"(ICRF\d*|GCRF\d*|EME2000|J2000)$")


def axes_of(frame: str) -> str:
    """Return a text that is the same for frames of the same axes; empty for no name."""
    name = re.sub(r"[\s_-]", "", frame.upper())
    return "ICRF" if _SAME_AXES.match(name) else name


def world_is_a(frame_a: str, frame_b: str) -> bool:
    """Return whether the first of two frames stands for the world, and not the second; raises ValueError otherwise."""
    is_world = [bool(_CELESTIAL.match(axes_of(frame))) for frame in (frame_a, frame_b)]
    if is_world[0] == is_world[1]:
        problem = "both are" if is_world[0] else "neither is"
        raise ValueError(
            f"REF_FRAME_A = {frame_a or 'missing'}, REF_FRAME_B = {frame_b or 'missing'}: one must be the world's "
            f"frame (ICRF, EME2000, MCI, IAU_EROS, ...) and the other the spacecraft's; {problem} known as the world's"
        )
    return is_world[0]
