"""Laws of reflection of surfaces, and sunlight.

r(i, e, g) in 1/sr, with mu0 = cos i of incidence, mu = cos e of emission, and g the phase angle between Sun and eye;
the radiance is L = r E, E the irradiance of a surface that faces the Sun. I/F = pi r.

    lambert             r = A mu0 / pi
    lommel-seeliger     r = (w / 4 pi) P(g) mu0 / (mu0 + mu)                 the right limb for dark bodies
    lunar-lambert       r = A [2 l(g) mu0 / (mu0 + mu) + (1 - l(g)) mu0] p(g) / pi
                        l(g) = 1 - 0.019 g + 2.42e-4 g^2 - 1.46e-6 g^3, g in degrees, held between 0 and 1
                        (McEwen 1996, LPSC 27, 841; USGS ISIS, LunarLambertMcEwen); p(g) = e^(-0.9 g), g in radians, an
                        approximation of the Moon's phase function
    hapke               r = (w / 4 pi) mu0 / (mu0 + mu) [(1 + B(g)) P(g) + H(mu0) H(mu) - 1]
                        B = B0 / (1 + tan(g / 2) / h),  H(x) = (1 + 2 x) / (1 + 2 x sqrt(1 - w))
                        (Hapke 1993, Theory of Reflectance and Emittance Spectroscopy; without roughness)

    glossy              r = A mu0 / pi + S (m + 8) / (8 pi) (n.h)^m mu0,  n.h = (mu0 + mu) / (2 cos(g / 2))
                        (Blinn's lobe around the mirror's direction, normalised: foil, solar cells, bare metal)

    water               r = T F(g / 2) e^(-tan^2 b / s) / (4 pi s mu cos^4 b (1 + V(mu0) + V(mu))),  cos b = n.h
                        s = 0.003 + 0.00512 W, the mean square slope of waves in wind of W m/s
                        (Cox and Munk 1954, J. Opt. Soc. Am. 44, 838: mirrors of any direction; F is Fresnel's share)
                        V(x) = (e^(-a^2) / (a sqrt(pi)) - erfc(a)) / 2,  a = x / sqrt(s (1 - x^2)), waves behind waves
                        (Smith 1967, IEEE Trans. Antennas Propag. 15, 668; for both directions Ross et al. 2005)
                        T = e^(-0.126 (m(mu0) + m(mu))),  m(x) = (x^2 + 2 H / (pi R))^(-1/2), through the Earth's air:
                        Rayleigh scattering, 0.0973 at 550 nm (Bucholtz 1995, Appl. Opt. 34, 2765), in the mean of 400
                        to 700 nm; m is 1 / x, at the horizon Chapman's sqrt(pi R / 2 H), H = 8 km
    air                 r = 3 (1 + cos^2 g) / (16 pi) m(mu) / p (1 - e^(-0.126 p)) (1 - A)^2,  p = 1 / mu0 + m(mu)
                        Rayleigh scattering, once, before ground of the albedo A (Chandrasekhar 1960, Radiative
                        Transfer; the last factor is that of a thin layer, 1 / mu0 ends light at the terminator)

with the phase function of Henyey and Greenstein, its mean over all directions 1, b < 0 scattering light back:

    P(g) = (1 - b^2) / (1 + 2 b cos g + b^2)^(3/2)

On the night side (mu0 <= 0) r is 0. The laws of a rig give their GLSL text too, the same formula in float32:

    float reflect_sun(float mu0, float mu, float phase)

All light is counted in the band that a silicon pixel and an eye share, 400 to 700 nm. There sunlight at 1 au is

    530 W/m2        133 600 lx        so 252 lm of sunlight a watt

(integrals of the solar spectrum; the total over all wavelengths is 1361 W/m2). Earthlight on the Moon under a full
Earth is about 15 lx, 0.06 W/m2 (Glenar et al. 2019 give 0.15 W/m2 over all wavelengths, half of it heat). Seen from
1 au the Sun's radius is 0.2666 degrees.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, ClassVar

import numpy as np
from msgspec import Meta

from firmware_protocol.bounds import Bounded, Share, check_bounds
from firmware_protocol.events import Floats

_TINY = 1e-12
_Asymmetry = Annotated[float, Meta(ge=-0.99, le=0.99)]


def henyey_greenstein(phase_rad: float | Floats, asymmetry: float) -> Floats:
    """Return P(g) of the module docstring."""
    b = asymmetry
    return np.asarray((1 - b * b) / (1 + 2 * b * np.cos(phase_rad) + b * b) ** 1.5)


def _seeliger(mu0: Floats, mu: Floats) -> Floats:
    return np.asarray(mu0 / np.maximum(mu0 + np.abs(mu), _TINY))


class _Law(Bounded):
    """Bounds and GLSL text of a law."""

    def glsl(self) -> str:
        """Return the law as GLSL: unlit points are black, and the cosine of emission counts by its magnitude."""
        return (
            "float seeliger(float mu0, float mu) { return mu0 / max(mu0 + mu, 1e-12); }\n"
            "float reflect_sun(float mu0, float mu, float phase) {\n"
            f"    if (mu0 <= 0.0) return 0.0;\n    mu = abs(mu);\n    {self._formula()}\n}}\n"
        )

    def _formula(self) -> str:
        raise NotImplementedError


@dataclass(frozen=True)
class Lambert(_Law):
    """Even in all directions: painted panels, test targets.

    Attributes
    ----------
    albedo : share of the light that is reflected.
    """

    kind: ClassVar[str] = "lambert"
    albedo: Share = 0.5

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        return np.asarray(self.albedo / math.pi * np.maximum(mu0, 0))

    def _formula(self) -> str:
        return f"return {self.albedo / math.pi!r} * mu0;"


@dataclass(frozen=True)
class LommelSeeliger(_Law):
    """Single scattering in a dark, porous ground: asteroids.

    Attributes
    ----------
    single_scattering_albedo
        w: share of light that a grain does not absorb; 0.33 for Eros at 550 nm (Li 2005).
    asymmetry
        b of the Henyey-Greenstein function: below 0 light is scattered back to its source; -0.25 for Eros.
    """

    kind: ClassVar[str] = "lommel-seeliger"
    single_scattering_albedo: Share = 0.33
    asymmetry: _Asymmetry = -0.25

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        scattered = henyey_greenstein(phase_rad, self.asymmetry) * self.single_scattering_albedo / (4 * math.pi)
        return np.asarray(scattered * _seeliger(np.maximum(mu0, 0), mu))

    def _formula(self) -> str:
        share = self.single_scattering_albedo / (4 * math.pi)
        return f"return {share!r} * {_HG.format(b=self.asymmetry)} * seeliger(mu0, mu);"


@dataclass(frozen=True)
class LunarLambert(_Law):
    """Between Lommel-Seeliger and Lambert, the Moon's mixture.

    Attributes
    ----------
    albedo : A: I/F of ground seen and lit straight on; 0.12 for the Moon's mean.
    """

    kind: ClassVar[str] = "lunar-lambert"
    albedo: Share = 0.12

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        g = np.degrees(phase_rad)
        share = np.clip(1 + g * (-0.019 + g * (2.42e-4 - 1.46e-6 * g)), 0, 1)
        lit = np.maximum(mu0, 0)
        mixture = 2 * share * _seeliger(lit, mu) + (1 - share) * lit
        return np.asarray(self.albedo / math.pi * np.exp(-0.9 * np.asarray(phase_rad)) * mixture)

    def _formula(self) -> str:
        g = "degrees(phase)"
        share = f"clamp(1.0 + {g} * (-0.019 + {g} * (2.42e-4 - 1.46e-6 * {g})), 0.0, 1.0)"
        scale = f"{self.albedo / math.pi!r} * exp(-0.9 * phase)"
        return (
            f"vec2 terms = {scale} * vec2(2.0 * {share}, 1.0 - {share});"
            " return terms.x * seeliger(mu0, mu) + terms.y * mu0;"
        )


@dataclass(frozen=True)
class Hapke(_Law):
    """Multiple scattering and the opposition surge.

    Attributes
    ----------
    single_scattering_albedo
        w: share of light that a grain does not absorb.
    asymmetry
        b of the Henyey-Greenstein function: below 0 light is scattered back to its source.
    surge : B0: height of the opposition surge.
    surge_width
        h, of the order of the angle, rad, over which it fades.
    """

    kind: ClassVar[str] = "hapke"
    single_scattering_albedo: Share = 0.33
    asymmetry: _Asymmetry = -0.25
    surge: Annotated[float, Meta(ge=0, le=10)] = 1.0
    surge_width: Annotated[float, Meta(ge=1e-4, le=10)] = 0.05

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        w = self.single_scattering_albedo
        lit, seen = np.maximum(mu0, 0), np.abs(mu)
        surge = 1 + self.surge / (1 + np.tan(np.asarray(phase_rad) / 2) / self.surge_width)
        once = surge * henyey_greenstein(phase_rad, self.asymmetry)
        gamma = math.sqrt(1 - w)
        often = (1 + 2 * lit) / (1 + 2 * lit * gamma) * (1 + 2 * seen) / (1 + 2 * seen * gamma) - 1
        return np.asarray(w / (4 * math.pi) * _seeliger(lit, seen) * (once + often))

    def _formula(self) -> str:
        w = self.single_scattering_albedo
        gamma = math.sqrt(1 - w)
        surge = f"(1.0 + {self.surge!r} / (1.0 + tan(0.5 * phase) / {self.surge_width!r}))"
        return (
            "float often = (1.0 + 2.0 * mu0) * (1.0 + 2.0 * mu)"
            f" / ((1.0 + 2.0 * mu0 * {gamma!r}) * (1.0 + 2.0 * mu * {gamma!r})) - 1.0;"
            f" return {w / (4 * math.pi)!r} * seeliger(mu0, mu) * ({surge} * {_HG.format(b=self.asymmetry)} + often);"
        )


@dataclass(frozen=True)
class Glossy(_Law):
    """A rough mirror over a diffuse ground: insulation foil, solar cells.

    Attributes
    ----------
    albedo : share of the light that is reflected diffusely.
    shine : share that is reflected around the mirror's direction.
    sharpness : exponent m of the lobe; its width is about 80 degrees / sqrt(m).
    """

    kind: ClassVar[str] = "glossy"
    albedo: Share = 0.2
    shine: Share = 0.5
    sharpness: Annotated[float, Meta(ge=1, le=1e5)] = 200.0

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        lit, m = np.maximum(mu0, 0), self.sharpness
        halfway = np.minimum((lit + np.abs(mu)) / (2 * np.maximum(np.cos(np.asarray(phase_rad) / 2), 1e-6)), 1)
        return np.asarray(lit * (self.albedo / math.pi + self.shine * (m + 8) / (8 * math.pi) * halfway**m))

    def _formula(self) -> str:
        lobe = self.shine * (self.sharpness + 8) / (8 * math.pi)
        return (
            "float halfway = min((mu0 + mu) * (0.5 / max(cos(0.5 * phase), 1e-6)), 1.0);"
            f" return mu0 * ({self.albedo / math.pi!r} + {lobe!r} * pow(halfway, {self.sharpness!r}));"
        )


@dataclass(frozen=True)
class Water:
    """The glint of the Sun on an ocean under clear air, beside another law for the light from under the waves.

    Attributes
    ----------
    wind_m_s : W, the speed of the wind 12 m above the water.
    """

    wind_m_s: float

    @property
    def slope2(self) -> float:
        """Return s of the module docstring."""
        return 0.003 + 0.00512 * self.wind_m_s

    def reflect(self, mu0: Floats, mu: Floats, phase_rad: float | Floats) -> Floats:
        """Return r, 1/sr."""
        slope2, cosine = self.slope2, np.maximum(np.cos(np.asarray(phase_rad) / 2), 1e-6)
        lit, seen = np.maximum(mu0, _LEAST), np.maximum(np.abs(mu), _LEAST)
        upright2 = np.clip((lit + seen) / (2 * cosine), _LEAST, 1) ** 2
        mirrors = np.exp((1 - 1 / upright2) / slope2) / (4 * math.pi * slope2 * upright2**2)
        refracted = np.sqrt(_WATER_INDEX**2 - 1 + cosine**2)  # the index times the cosine under water
        across = (cosine - refracted) / (cosine + refracted)
        along = (_WATER_INDEX**2 * cosine - refracted) / (_WATER_INDEX**2 * cosine + refracted)
        hidden = 1 + _behind_waves(lit, slope2) + _behind_waves(seen, slope2)
        air = np.exp(-_AIR_DEPTH * (1 / np.sqrt(lit**2 + _AIR_CURVED) + 1 / np.sqrt(seen**2 + _AIR_CURVED)))
        r = air * (across**2 + along**2) / 2 * mirrors / (seen * hidden)
        return np.asarray(np.where(np.asarray(mu0) > 0, r, 0.0))


_LEAST = 1e-4  # of a cosine: nearer to the horizon the law of water stays as it is there
_WATER_INDEX = 1.34
_AIR_DEPTH, _AIR_CURVED = 0.126, 2 * 8.0 / (math.pi * 6371.0)
PLANET_ALBEDO = 0.3  # the mean of the Earth's ground and clouds, before which its air is


def air_light(mu0: Floats, mu: Floats, phase_rad: Floats, ground: float | Floats) -> Floats:
    """Return r of the Earth's air before ground of this albedo, 1/sr."""
    down, up = 1 / np.maximum(mu0, _TINY), 1 / np.sqrt(mu**2 + _AIR_CURVED)
    scattered = 3 * (1 + np.cos(phase_rad) ** 2) / (16 * math.pi) * -np.expm1(-_AIR_DEPTH * (down + up))
    return np.asarray(np.where(mu0 > 0, scattered * up / (down + up) * (1 - ground) ** 2, 0.0))


def _behind_waves(cosine: Floats, slope2: float) -> Floats:
    """Return V of the module docstring."""
    from scipy.special import erfc  # loaded where it is used: most scenes have no water

    a = cosine / np.sqrt(slope2 * np.maximum(1 - cosine**2, _TINY))
    return np.asarray((np.exp(-a * a) / (a * math.sqrt(math.pi)) - erfc(a)) / 2)


Reflectance = Lambert | LommelSeeliger | LunarLambert | Hapke | Glossy
"""Any of them, as the type of a key in a rig's table."""

_HG = "(1.0 - ({b!r}) * ({b!r})) / pow(1.0 + 2.0 * ({b!r}) * cos(phase) + ({b!r}) * ({b!r}), 1.5)"

SUN_W_M2 = 530.0
LUMENS_A_WATT = 133_600.0 / SUN_W_M2
EARTHLIGHT_W_M2 = 0.06
_RADIUS_DEG = 0.2666


@dataclass(frozen=True)
class Sun:
    """Direction and distance of the Sun.

    Attributes
    ----------
    direction : towards the Sun in the world; need not be of unit length.
    distance_au : distance from the Sun, astronomical units.
    """

    direction: tuple[float, float, float] = (0.0, 0.0, -1.0)
    distance_au: Annotated[float, Meta(ge=0.01, le=1000)] = 1.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if not any(self.direction) or not all(map(math.isfinite, self.direction)):
            raise ValueError(f"direction is {self.direction}: it must be finite and point somewhere")

    @property
    def irradiance_w_m2(self) -> float:
        """Irradiance of a surface that faces the Sun, 400 to 700 nm."""
        return SUN_W_M2 / self.distance_au**2

    @property
    def radius_rad(self) -> float:
        """Angular radius of the Sun's disc."""
        return math.radians(_RADIUS_DEG) / self.distance_au
