"""The geometry of a camera without distortion: directions to pixels.

    column = centre_x + focal_px * x / z        row = centre_y + focal_px * y / z

with camera axes x right, y down, z out along the boresight, and pixel k covering k to k + 1, so that the centre of a
picture of `width` pixels is width / 2.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["Pinhole"]


@dataclass(frozen=True)
class Pinhole:
    """A picture's size and scale, the boresight in its middle.

    Attributes
    ----------
    width, height : pixels.
    focal_px : focal length over pixel pitch.
    """

    width: int
    height: int
    focal_px: float

    def __post_init__(self) -> None:
        if self.width < 1 or self.height < 1:
            raise ValueError(f"a picture needs at least one pixel, got {self.width} x {self.height}")
        if not 0 < self.focal_px < math.inf:
            raise ValueError(f"focal_px must be above 0 and finite, got {self.focal_px:g}")

    @classmethod
    def of_field(cls, size: tuple[int, int], field_of_view_deg: float) -> Pinhole:
        """Return the camera whose picture of `size` = (width, height) is `field_of_view_deg` wide, edge to edge."""
        if not 0 < field_of_view_deg < 180:
            raise ValueError(f"field_of_view_deg is {field_of_view_deg:g}: it must be between 0 and 180")
        return cls(*size, size[0] / 2 / math.tan(math.radians(field_of_view_deg) / 2))

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), pixels."""
        return self.width, self.height

    @property
    def field_of_view_deg(self) -> float:
        """Of the picture's width, edge to edge."""
        return math.degrees(2 * math.atan(self.width / 2 / self.focal_px))

    @property
    def zoom(self) -> tuple[float, float]:
        """Focal length over half the picture's width and height: what GL's projection wants."""
        return 2 * self.focal_px / self.width, 2 * self.focal_px / self.height

    @property
    def widest_rad(self) -> float:
        """From the boresight to a corner."""
        return math.atan(math.hypot(self.width, self.height) / 2 / self.focal_px)

    def widened(self, margin_px: int) -> Pinhole:
        """Return the same with a margin on every side, for what must look beyond the picture's edge."""
        return Pinhole(self.width + 2 * margin_px, self.height + 2 * margin_px, self.focal_px)
