"""The [second_camera] table of a rig: a camera beside the first one, on its clock, looking at the same scene."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["SecondCamera"]


@dataclass(frozen=True)
class SecondCamera:
    """A second camera of the same model, mounted beside the first; its clock is the slave of the first one's.

    Attributes
    ----------
    links
        Names of the links that carry it; the others carry the first camera.
    serial
        Its serial number, up to 8 characters.
    offset_m
        Where it is, along the first camera's axes: x right, y down, z along the boresight.
    q_first_from_second
        How it is turned against the first one: unit quaternion, scalar first.
    """

    links: tuple[str, ...]
    serial: str = "00000347"
    offset_m: tuple[float, float, float] = (0.1, 0.0, 0.0)
    q_first_from_second: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)

    def __post_init__(self) -> None:
        if not self.links:
            raise ValueError("links must name the links that carry this camera")
        if not 1 <= len(self.serial) <= 8 or not self.serial.isascii() or not self.serial.isprintable():
            raise ValueError(f"serial must have 1 to 8 printable ASCII characters, got {self.serial!r}")
        if not all(abs(part) <= 1e9 for part in self.offset_m):  # NaN compares false
            raise ValueError(f"offset_m must be three numbers of at most 1e9, got {self.offset_m}")
        if not abs(math.hypot(*self.q_first_from_second) - 1) < 1e-3:
            raise ValueError(f"q_first_from_second must be a unit quaternion, got {self.q_first_from_second}")
