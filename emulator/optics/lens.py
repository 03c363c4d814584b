"""The lens of a camera: the light on the chip, the blur, and distortion.

    chip irradiance    E = pi tau L / (4 N^2)            far object of radiance L; times cos^4 off the axis
    chip lux           252 lm/W of sunlight, 400 to 700 nm (see `photometry.reflectance`)
    light              chip lux / reference_lux: the input of pixels, 1 at the sensor's reference
    photocurrent       I = q FF A QE E lambda / (h c) at 555 nm
    blur               Gaussian of standard deviation sqrt(own^2 + airy^2 + defocus^2), pixels;
                       airy = 0.42 lambda N / pitch (the Gaussian nearest to Airy's disc), and a disc of confusion of
                       diameter c counts as c / 4: c = f^2 / (N (s - f)) |s - d| / d for focus at s, object at d

The irradiance is pi tau L sin^2 u with u the half angle of the cone of light on the chip. A photographic lens is
aplanatic (Abbe's sine condition), so the sine is 1 / (2 N), and a star (an irradiance through the area of the aperture)
and a surface of the same light agree at every f-number. The other common form, 1 / (4 N^2 + 1), takes 1 / (2 N) for the
tangent: it is 11 % lower at f/1.4. Source: Born and Wolf, Principles of Optics, sections 4.5.1 and 4.8.

The reference is an estimate: 1 klux on a scene of middle grey through f/1.4 is about 50 lx on the chip. The records of
the cameras have the chip's parameters.

Distortion follows the model of Brown and Conrady, as OpenCV writes it. With x, y the tangents of a direction
(x / z, y / z) and r^2 = x^2 + y^2, its image is at

    x' = x (1 + k1 r^2 + k2 r^4 + k3 r^6) + 2 p1 x y + p2 (r^2 + 2 x^2)
    y' = y (1 + k1 r^2 + k2 r^4 + k3 r^6) + p1 (r^2 + 2 y^2) + 2 p2 x y

Its inverse has no closed form: Newton's method finds it, to 1e-12, wherever the model is one to one. A lens whose model
folds over inside the image is refused, with the angle up to which it is valid.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np
from msgspec import Meta

from emulator.geometry.camera import Pinhole, Rays
from emulator.photometry.reflectance import LUMENS_A_WATT
from firmware_protocol.bounds import Bounded
from firmware_protocol.events import Floats

_WAVELENGTH_M = 555e-9
_ELECTRON_C = 1.602176634e-19
_PLANCK_J_S, _LIGHT_M_S = 6.62607015e-34, 299_792_458.0
_AIRY = 0.42


@dataclass(frozen=True)
class Chip:
    """Pixel pitch and efficiency of a sensor.

    Attributes
    ----------
    pitch_um : distance of pixels.
    fill_factor : share of a pixel that takes light.
    quantum_efficiency : electrons a photon, at its peak.
    """

    pitch_um: float
    fill_factor: float
    quantum_efficiency: float

    def photocurrent_a(self, irradiance_w_m2: float) -> float:
        """Return the current of one pixel, A."""
        area_m2 = (self.pitch_um * 1e-6) ** 2
        photons_s = irradiance_w_m2 * area_m2 * self.fill_factor * _WAVELENGTH_M / (_PLANCK_J_S * _LIGHT_M_S)
        return photons_s * self.quantum_efficiency * _ELECTRON_C


_STEPS = 30


class DistortionError(ValueError):
    """The coefficients of a lens fold the image over itself."""


_Coefficient = Annotated[float, Meta(ge=-10, le=10)]


@dataclass(frozen=True)
class LensParameters(Bounded):
    """The lens of a camera, for scenes in units of radiance.

    Attributes
    ----------
    field_of_view_deg : field of view of the image's width, edge to edge.
    f_number : focal length over aperture.
    transmission : share of the light that passes.
    reference_lux : light on the chip at which the sensor's parameters are valid (light 1).
    blur_px : the lens's own point spread, standard deviation of a Gaussian, pixels.
    focus_m : distance in focus; 0: infinity.
    vignetting : True: light falls as cos^4 off the axis.
    k1, k2, k3 : radial distortion (Brown and Conrady, as OpenCV writes it).
    p1, p2 : tangential distortion.
    veiling_glare
        Share of the light that the lens scatters evenly over the image (veiling glare index, ISO 9358): 0.01 to
        0.05 for usual lenses (not verified). Costs time: no pixel can be skipped.
    halo : share of the light that rough and dirty surfaces of the lens scatter about each source. Costs time likewise.
    halo_px
        Knee of the halo: from there on it falls as a power of the distance, pixels; 0.1 to 10 mrad for polished glass.
    halo_power : that power: 0.5 to 2 for polished glass, above 2.5 for the best polish.
    """

    field_of_view_deg: Annotated[float, Meta(ge=0.001, le=170)] = 25.0
    f_number: Annotated[float, Meta(ge=0.5, le=128)] = 2.0
    transmission: Annotated[float, Meta(ge=0.001, le=1)] = 0.9
    reference_lux: Annotated[float, Meta(ge=1e-6, le=1e6)] = 50.0
    blur_px: Annotated[float, Meta(ge=0, le=20)] = 0.0
    focus_m: Annotated[float, Meta(ge=0, le=1e12)] = 0.0
    vignetting: bool = True
    k1: _Coefficient = 0.0
    k2: _Coefficient = 0.0
    k3: _Coefficient = 0.0
    p1: _Coefficient = 0.0
    p2: _Coefficient = 0.0
    veiling_glare: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    halo: Annotated[float, Meta(ge=0, le=0.5)] = 0.0
    halo_px: Annotated[float, Meta(ge=0.5, le=10_000)] = 2.0
    halo_power: Annotated[float, Meta(ge=0.1, le=10)] = 1.5

    @property
    def chip_share(self) -> float:
        """Irradiance of the chip, W/m2, a unit of radiance, W m-2 sr-1, on the axis."""
        return math.pi * self.transmission / (4 * self.f_number**2)

    @property
    def light_per_radiance(self) -> float:
        """Light relative to the sensor's reference, a unit of radiance, on the axis."""
        return self.chip_share * LUMENS_A_WATT / self.reference_lux

    def chip_irradiance_w_m2(self, light: float) -> float:
        """Return the irradiance of the chip at a relative light, 400 to 700 nm."""
        return light * self.reference_lux / LUMENS_A_WATT

    def pinhole(self, size: tuple[int, int]) -> Pinhole:
        """Return the geometry of the image, without distortion."""
        return Pinhole.of_field(size, self.field_of_view_deg)

    def blur_sigma_px(self, chip: Chip, focal_px: float, distance_m: float = math.inf) -> float:
        """Return the standard deviation of the blur of objects `distance_m` away, pixels."""
        airy = _AIRY * _WAVELENGTH_M * self.f_number / (chip.pitch_um * 1e-6)
        return math.hypot(self.blur_px, airy, self.confusion_px(chip, focal_px, distance_m) / 4)

    def confusion_px(self, chip: Chip, focal_px: float, distance_m: float) -> float:
        """Return the diameter of the disc into which a point `distance_m` away is spread by defocus, pixels."""
        focal_m = focal_px * chip.pitch_um * 1e-6
        away, focus = 1 / distance_m, 1 / self.focus_m if self.focus_m else 0.0
        # |s - d| / (d (s - f)) with s and d as their inverses, so that infinity is no special case
        spread = abs(away - focus) / max(1 - focal_m * focus, 1e-9)
        return focal_m * focal_m / self.f_number * spread / (chip.pitch_um * 1e-6)

    def bend(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the images of directions with tangents `x`, `y`, as tangents again."""
        rr = x * x + y * y
        radial = 1 + rr * (self.k1 + rr * (self.k2 + rr * self.k3))
        return (
            x * radial + 2 * self.p1 * x * y + self.p2 * (rr + 2 * x * x),
            y * radial + self.p1 * (rr + 2 * y * y) + 2 * self.p2 * x * y,
        )

    def straighten(self, x: Floats, y: Floats) -> tuple[Floats, Floats]:
        """Return the directions with images at `x`, `y`; raises DistortionError where there is none."""
        u, v = x.copy(), y.copy()
        for _ in range(_STEPS):
            (at_x, at_y), (xx, xy, yy) = self.bend(u, v), self.stretch(u, v)
            determinant = xx * yy - xy * xy
            off_x, off_y = at_x - x, at_y - y
            with np.errstate(divide="ignore", invalid="ignore"):
                u, v = u - (yy * off_x - xy * off_y) / determinant, v - (xx * off_y - xy * off_x) / determinant
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
        return u, v

    def stretch(self, x: Floats, y: Floats) -> tuple[Floats, Floats, Floats]:
        """Return the stretch of the image at directions with tangents `x`, `y`: dx'/dx, dx'/dy = dy'/dx, dy'/dy."""
        rr = x * x + y * y
        radial = 1 + rr * (self.k1 + rr * (self.k2 + rr * self.k3))
        slope = 2 * (self.k1 + rr * (2 * self.k2 + 3 * rr * self.k3))
        return (
            radial + slope * x * x + 2 * self.p1 * y + 6 * self.p2 * x,
            slope * x * y + 2 * self.p1 * x + 2 * self.p2 * y,
            radial + slope * y * y + 6 * self.p1 * y + 2 * self.p2 * x,
        )


def straight_columns_and_rows(lens: LensParameters, camera: Pinhole) -> tuple[Floats, Floats]:
    """Return pixel centres in an undistorted image of the same scale: (height, width) each, pixels from its middle."""
    straight, focal_px = Rays.straight(camera), camera.focal_px
    x, y = (straight.columns - camera.width / 2) / focal_px, (straight.rows - camera.height / 2) / focal_px
    u, v = lens.straighten(x, y)
    return u * focal_px, v * focal_px


def bent_rays(lens: LensParameters, columns: Floats, rows: Floats, camera: Pinhole) -> Rays:
    """Return the rays of pixels whose middles `straight_columns_and_rows` gives."""
    bend = np.stack(lens.stretch(columns / camera.focal_px, rows / camera.focal_px), axis=-1)
    return Rays(columns + camera.width / 2, rows + camera.height / 2, bend)
