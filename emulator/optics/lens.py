"""The lens of a camera: how much light reaches the chip, how sharp the picture is, and where things appear.

    chip irradiance    E = pi tau L / (4 N^2)            far object of radiance L; times cos^4 off the axis
    chip lux           252 lm/W of sunlight, 400 to 700 nm (see `photometry.sun`)
    light              chip lux / reference_lux: what pixels work on, 1 at the sensor's reference
    photocurrent       I = q FF A QE E lambda / (h c) at 555 nm
    blur               Gaussian of standard deviation sqrt(own^2 + airy^2 + defocus^2), pixels;
                       airy = 0.42 lambda N / pitch (the Gaussian nearest to Airy's disc), and a disc of confusion of
                       diameter c counts as c / 4: c = f^2 / (N (s - f)) |s - d| / d for focus at s, object at d

The irradiance is pi tau L sin^2 u with u the half angle of the cone of light on the chip. A photographic lens is
aplanatic (Abbe's sine condition), so the sine is 1 / (2 N), and a star (an irradiance through the area of the aperture)
and a surface of the same light agree at every f-number. The other common form, 1 / (4 N^2 + 1), takes 1 / (2 N) for the
tangent: it is 11 % lower at f/1.4. Source: Born and Wolf, Principles of Optics, sections 4.5.1 and 4.8.

The chip's figures are estimates (fill factor 22 %, peak efficiency 24 % for the front-illuminated DAVIS346; pitch as in
its data sheet), and so is the reference: 1 klux on a scene of middle grey through f/1.4 is some 50 lx on the chip.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from emulator.geometry.pinhole import Pinhole
from emulator.photometry.sun import LUMENS_A_WATT

__all__ = ["CHIPS", "Chip", "LensParameters"]

_WAVELENGTH_M = 555e-9
_ELECTRON_C, _PLANCK_J_S, _LIGHT_M_S = 1.602176634e-19, 6.62607015e-34, 299_792_458.0
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


CHIPS = {
    "davis346": Chip(18.5, 0.22, 0.24),
    "dvxplorer_micro": Chip(9.0, 0.22, 0.24),
    "imx636": Chip(4.86, 0.77, 0.7),
}
"""Chips by camera model; the first lines of the module say how well they are known."""


@dataclass(frozen=True)
class LensParameters:
    """The lens of a camera, for scenes in units of radiance.

    Attributes
    ----------
    field_of_view_deg
        Of the picture's width, edge to edge.
    f_number
        Focal length over aperture.
    transmission
        Share of the light that passes.
    reference_lux
        Light on the chip at which the sensor's figures hold (light 1).
    blur_px
        The lens's own point spread, standard deviation of a Gaussian, pixels.
    focus_m
        Distance in focus; 0: infinity.
    vignetting
        Whether light falls as cos^4 off the axis.
    k1, k2, k3
        Radial distortion (Brown and Conrady, as OpenCV writes it).
    p1, p2
        Tangential distortion.
    """

    field_of_view_deg: float = 25.0
    f_number: float = 2.0
    transmission: float = 0.9
    reference_lux: float = 50.0
    blur_px: float = 0.0
    focus_m: float = 0.0
    vignetting: bool = True
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    p1: float = 0.0
    p2: float = 0.0

    def __post_init__(self) -> None:
        bounds = {
            "field_of_view_deg": (0.001, 170.0),
            "f_number": (0.5, 128.0),
            "transmission": (0.001, 1.0),
            "reference_lux": (1e-6, 1e6),
            "blur_px": (0.0, 20.0),
            "focus_m": (0.0, 1e12),
            **dict.fromkeys(("k1", "k2", "k3", "p1", "p2"), (-10.0, 10.0)),
        }
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} is {getattr(self, name)}: it must be {low:g} to {high:g}")

    @property
    def chip_share(self) -> float:
        """Irradiance of the chip, W/m2, a unit of radiance, W m-2 sr-1, on the axis."""
        return math.pi * self.transmission / (4 * self.f_number**2)

    @property
    def light_per_radiance(self) -> float:
        """Light relative to the sensor's reference, a unit of radiance, on the axis."""
        return self.chip_share * LUMENS_A_WATT / self.reference_lux

    @property
    def distorts(self) -> bool:
        """Whether straight lines are bent."""
        return any((self.k1, self.k2, self.k3, self.p1, self.p2))

    def chip_lux(self, light: float) -> float:
        """Return the illuminance of the chip at a relative light."""
        return light * self.reference_lux

    def chip_irradiance_w_m2(self, light: float) -> float:
        """Return the irradiance of the chip at a relative light, 400 to 700 nm."""
        return light * self.reference_lux / LUMENS_A_WATT

    def pinhole(self, size: tuple[int, int]) -> Pinhole:
        """Return the geometry of the picture, without distortion."""
        return Pinhole.of_field(size, self.field_of_view_deg)

    def blur_sigma_px(self, chip: Chip, focal_px: float, distance_m: float = math.inf) -> float:
        """Return the standard deviation of the blur of what is `distance_m` away, pixels."""
        airy = _AIRY * _WAVELENGTH_M * self.f_number / (chip.pitch_um * 1e-6)
        return math.hypot(self.blur_px, airy, self.confusion_px(chip, focal_px, distance_m) / 4)

    def confusion_px(self, chip: Chip, focal_px: float, distance_m: float) -> float:
        """Return the diameter of the disc into which a point `distance_m` away is spread by defocus, pixels."""
        focal_m = focal_px * chip.pitch_um * 1e-6
        away, focus = 1 / distance_m, 1 / self.focus_m if self.focus_m else 0.0
        # |s - d| / (d (s - f)) with s and d as their inverses, so that infinity is no special case
        spread = abs(away - focus) / max(1 - focal_m * focus, 1e-9)
        return focal_m * focal_m / self.f_number * spread / (chip.pitch_um * 1e-6)
