"""Lens distortion by the model of Brown and Conrady, as OpenCV writes it.

With x, y the tangents of a direction (x / z, y / z) and r^2 = x^2 + y^2, the picture shows it at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Its inverse has no closed form: Newton's method finds it, to 1e-12, wherever the model is one to one. A lens whose model
folds over inside the picture is refused, with how far it holds.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.geometry.seen import Rays
from emulator.optics.lens import LensParameters

__all__ = ["Distortion", "DistortionError", "bent_rays", "straight_columns_and_rows"]

Floats = npt.NDArray[np.float64]

_STEPS = 30


class DistortionError(ValueError):
    """The coefficients of a lens fold the picture over itself."""


@dataclass(frozen=True)
class Distortion:
    """Distortion coefficients of one lens."""

    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    @classmethod
    def of(cls, lens: LensParameters) -> Distortion:
        """Return the distortion of a rig's lens."""
        return cls(lens.k1, lens.k2, lens.k3, lens.p1, lens.p2)

    def bend(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return where directions with tangents `x`, `y` are seen, as tangents again."""
        rr = x * x + y * y
        radial = 1 + rr * (self.k1 + rr * (self.k2 + rr * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (rr + 2 * x * x),
            y * radial + self.p1 * (rr + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def straighten(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the directions that are seen at `x`, `y`; raises DistortionError where there is none."""
        u, v = x.copy(), y.copy()
        for _ in range(_STEPS):
            (at_x, at_y), (xx, xy, yy) = self.bend(u, v), self.stretch(u, v)
            determinant = xx * yy - xy * xy
            off_x, off_y = at_x - x, at_y - y
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = u - (yy * off_x - xy * off_y) / determinant, v - (xx * off_y - xy * off_x) / determinant
        self._require_inverse(u, v, x, y)
        return u, v

    def stretch(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return how the picture is stretched at directions with tangents `x`, `y`: dx'/dx, dx'/dy = dy'/dx, dy'/dy."""
        rr = x * x + y * y
        radial = 1 + rr * (self.k1 + rr * (self.k2 + rr * self.k3))
        slope = 2 * (self.k1 + rr * (2 * self.k2 + 3 * rr * self.k3))
        return (
            radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x,
            slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x,
        )

    def _require_inverse(self, u: Floats, v: Floats, x: Floats, y: Floats) -> None:
        with np.errstate(over="ignore", invalid="ignore"):
            at_x, at_y = self.bend(u, v)
            xx, xy, yy = self.stretch(u, v)
            good = (np.hypot(at_x - x, at_y - y) < 1e-9) & (xx * yy - xy * xy > 0)
        if not good.all():
            reach = float(np.hypot(x, y)[~good].min())
            raise DistortionError(
                f"k1, k2, k3, p1, p2 = {self.k1:g}, {self.k2:g}, {self.k3:g}, {self.p1:g}, {self.p2:g} "
                f"fold the picture over itself from {np.degrees(np.arctan(reach)):.1f} degrees off the axis on: "
                "the picture is wider"
            )


def straight_columns_and_rows(distortion: Distortion, camera: Pinhole) -> tuple[Floats, Floats]:
    """Return where, in a picture without distortion and of the same scale, each pixel's centre lies, (height, width).

    Measured from the middle of the picture, in pixels.
    """
    x, y = np.meshgrid(
        (np.arange(camera.width) + 0.5 - camera.width / 2) / camera.focal_px,
        (np.arange(camera.height) + 0.5 - camera.height / 2) / camera.focal_px,
    )
    u, v = distortion.straighten(x, y)
    return u * camera.focal_px, v * camera.focal_px


def bent_rays(distortion: Distortion, places: tuple[Floats, Floats], camera: Pinhole) -> Rays:
    """Return where pixels look, whose middles lie at `places` (see `straight_columns_and_rows`) before `camera`."""
    columns, rows = places
    bend = np.stack(distortion.stretch(columns / camera.focal_px, rows / camera.focal_px), axis=-1)
    return Rays(columns + camera.width / 2, rows + camera.height / 2, bend)
