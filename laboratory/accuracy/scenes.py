"""Light in closed form: a row of pixels, in float64, at any instant, with its time derivative.

Level 1 is the sensor's reference light. `jumps_s` gives the times of jumps; `value` there is the light after the jump.
A method under test does not get these times.

    scene                 light of a pixel
    SineGrating           mean (1 + m sin(2 pi f t + phase)), phases spread over the row; m = 0.7 is 5.7 : 1
    Flicker               the same for all pixels at once
    MovingEdge            dark + (bright - dark) Phi((v (t - T/2) - x) / sigma), Phi the normal distribution function
    BlurredCheckerboard   middle + amplitude X(x - v_x t) Y(y - v_y t), square waves blurred by the same Gaussian
    TexturedDisc          exp of four plane waves fixed to a disc that turns
    DriftingStar          background + peak exp(-d^2 / 2 sigma^2), d the distance to a star on its way
    Flash                 dark until an instant of the pixel's own, then bright
    SlowRamp              level exp(k t), another k for each pixel
    LogSine               level exp(a sin(2 pi f t + phase)): light of the scenes with noise; a = 0: still
    LogEdge               log light on a logistic curve in time
    Dark                  no light at all

Edges with a given profile, which a cubic in log light approximates badly: a profile is "blurred", a Gaussian edge, or
"kinked", a linear ramp of the same rms, as from averaging a sharp edge without blur over a pixel. Light is flat or
nearly so, and an edge enters within a step.

    ShadedEdge     an edge between two surfaces whose light drifts by some per cent
    ThinLine       a bright line of 1 px
    TurningBody    a textured ellipse that turns before a dim sky

`Faded` is another scene, dimmed at the start.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import expit, ndtr

Float64s = npt.NDArray[np.float64]


@dataclass(frozen=True)
class ClosedLight(ABC):
    """Light on a row of `pixels` pixels."""

    pixels: int = 60

    @abstractmethod
    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """Return the light and its time derivative at times (m, 1), s: (m, pixels), or what broadcasts to that."""

    def value(self, t_s: npt.ArrayLike) -> Float64s:
        """Return the light at times `t_s`, (m,) s: (m, pixels), relative to the reference light."""
        return self.light_and_rate(t_s)[0]

    def rate(self, t_s: npt.ArrayLike) -> Float64s:
        """Return the time derivative of `value`, (m, pixels), a second."""
        return self.light_and_rate(t_s)[1]

    def light_and_rate(self, t_s: npt.ArrayLike) -> tuple[Float64s, Float64s]:
        """Return `value` and `rate`."""
        t = np.atleast_1d(np.asarray(t_s, np.float64))[:, None]
        light, rate = (np.array(np.broadcast_to(one, (t.size, self.pixels))) for one in self.light(t))
        return light, rate

    def jumps_s(self) -> Float64s:
        """Return the times at which the light of each pixel jumps, (pixels, k) s, rising along the second axis."""
        return np.empty((self.pixels, 0))

    def _share(self) -> Float64s:
        """Return each pixel's place in the row, from 0 to 1."""
        return np.linspace(0, 1, self.pixels)


def _bell(x: Float64s) -> Float64s:
    """Return the normal density at x, any shape."""
    return np.asarray(np.exp(-0.5 * x * x) / math.sqrt(2 * math.pi))


@dataclass(frozen=True)
class _LogLight(ClosedLight):
    """Light whose logarithm is in closed form."""

    @abstractmethod
    def log(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """Return ln of the light and its time derivative, as `light` does."""

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        log, slope = self.log(t)
        return np.exp(log), np.exp(log) * slope


@dataclass(frozen=True)
class LogSine(_LogLight):
    """A sine in log light about that of `level`, its phases spread over that share of a turn; 0: all pixels alike."""

    amplitude: float = 0.5
    hz: float = 2.0
    level: float = 1.0
    spread: float = 1.0

    def log(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `_LogLight`."""
        omega = 2 * math.pi * self.hz
        angle = omega * t + 2 * math.pi * self.spread * np.arange(self.pixels) / self.pixels
        return math.log(self.level) + self.amplitude * np.sin(angle), self.amplitude * omega * np.cos(angle)


@dataclass(frozen=True)
class LogEdge(_LogLight):
    """Log light that rises by `height` to that of `level` on a logistic curve of width `width_s` about `middle_s`."""

    height: float = 1.0
    width_s: float = 1e-3
    middle_s: float = 0.02
    level: float = 1.0

    def log(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `_LogLight`."""
        share = expit((t - self.middle_s) / self.width_s)
        return math.log(self.level) + self.height * (share - 1), self.height * share * (1 - share) / self.width_s


@dataclass(frozen=True)
class SineGrating(ClosedLight):
    """A sine in linear light, `modulation` < 1, its phases spread over that share of a turn."""

    hz: float = 20.0
    modulation: float = 0.7
    mean: float = 1.0
    spread: float = 1.0

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        omega, size = 2 * math.pi * self.hz, self.mean * self.modulation
        angle = omega * t + 2 * math.pi * self.spread * np.arange(self.pixels) / self.pixels
        return self.mean + size * np.sin(angle), size * omega * np.cos(angle)


@dataclass(frozen=True)
class Flicker(SineGrating):
    """A lamp on the mains: all pixels in phase."""

    hz: float = 100.0
    modulation: float = 0.5
    spread: float = 0.0


@dataclass(frozen=True)
class MovingEdge(ClosedLight):
    """An edge blurred by `sigma_px`, passing the middle of the row half way through `duration_s`."""

    sigma_px: float = 0.5
    speed_px_s: float = 100.0
    dark: float = 0.1
    bright: float = 1.0
    duration_s: float = 0.4
    half_width_px: float = 12.0

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        x, height = self.half_width_px * (2 * self._share() - 1), self.bright - self.dark
        sigmas = (self.speed_px_s * (t - self.duration_s / 2) - x) / self.sigma_px
        return self.dark + height * ndtr(sigmas), height * _bell(sigmas) * (self.speed_px_s / self.sigma_px)


@dataclass(frozen=True)
class BlurredCheckerboard(ClosedLight):
    """A checkerboard blurred by `sigma_px` (at most a third of a square), moving in direction `angle_rad`."""

    sigma_px: float = 0.5
    speed_px_s: float = 100.0
    square_px: float = 12.0
    dark: float = 0.1
    bright: float = 1.0
    angle_rad: float = 0.3

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        k = np.arange(self.pixels)
        x0, y0 = k * 1.0, (k * 0.618034 * self.square_px) % (2 * self.square_px)
        vx, vy = self.speed_px_s * math.cos(self.angle_rad), self.speed_px_s * math.sin(self.angle_rad)
        (x, slope_x), (y, slope_y) = self._square_wave(x0 - vx * t), self._square_wave(y0 - vy * t)
        middle, half = (self.bright + self.dark) / 2, (self.bright - self.dark) / 2
        return middle + half * x * y, -half * (vx * slope_x * y + vy * slope_y * x)

    def _square_wave(self, x: Float64s) -> tuple[Float64s, Float64s]:
        """Return the blurred square wave, -1 to 1, rising at x = 0, and its slope: the two edges next to x."""
        side, sigma = self.square_px, self.sigma_px
        place = (x + side / 2) % side - side / 2
        sign = 1 - 2 * (np.floor((x + side / 2) / side) % 2)
        wave = np.zeros_like(x)
        slope = np.zeros_like(x)
        for edge, up in ((-side, -1), (0.0, 1), (side, -1)):
            wave += up * (2 * ndtr((place - edge) / sigma) - 1)
            slope += up * 2 * _bell((place - edge) / sigma) / sigma
        return sign * wave, sign * slope


_WAVES = (
    # wavelength px, direction rad, phase rad, amplitude ln
    (8.0, 0.4, 0.0, 0.35),
    (13.0, 1.9, 1.0, 0.35),
    (21.0, 3.1, 2.0, 0.45),
    (34.0, 5.2, 4.0, 0.45),
)


@dataclass(frozen=True)
class TexturedDisc(_LogLight):
    """A textured disc turning about its middle; pixels at radii up to `radius_px`, all round."""

    turn_rad_s: float = 1.0
    radius_px: float = 60.0
    level: float = 0.4

    def log(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `_LogLight`."""
        radius = 3 + (self.radius_px - 3) * self._share()
        angle = 2.399963 * np.arange(self.pixels) - self.turn_rad_s * t
        log, slope = np.full_like(angle, math.log(self.level)), np.zeros_like(angle)
        for wavelength, direction, phase, amplitude in _WAVES:
            k = 2 * math.pi / wavelength
            argument = k * radius * np.cos(angle - direction) + phase
            log += amplitude * np.sin(argument)
            slope += amplitude * np.cos(argument) * k * radius * np.sin(angle - direction) * self.turn_rad_s
        return log, slope


@dataclass(frozen=True)
class DriftingStar(ClosedLight):
    """A star drifting along the row, `ratio` times as bright as the sky; pixels lie up to 1.5 px off its way."""

    sigma_px: float = 0.7
    speed_px_s: float = 17.0
    sky: float = 0.02
    ratio: float = 200.0

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        x = (-1 + 9 * self._share() - self.speed_px_s * t) / self.sigma_px
        y = (np.arange(self.pixels) % 4) * 0.5 / self.sigma_px
        star = self.sky * (self.ratio - 1) * np.exp(-(x**2 + y**2) / 2)
        return self.sky + star, star * x * self.speed_px_s / self.sigma_px


@dataclass(frozen=True)
class Flash(ClosedLight):
    """A light that is switched on at a different instant for each pixel, between `first_s` and `last_s`."""

    dark: float = 0.01
    bright: float = 1.0
    first_s: float = 0.02
    last_s: float = 0.04

    def jumps_s(self) -> Float64s:
        """See `ClosedLight`."""
        return (self.first_s + (self.last_s - self.first_s) * (np.arange(self.pixels) + 0.5) / self.pixels)[:, None]

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        return np.where(t < self.jumps_s()[:, 0], self.dark, self.bright), np.zeros(1)


@dataclass(frozen=True)
class SlowRamp(_LogLight):
    """Light that grows by a constant factor a second, `slowest` to `fastest` ln units a second over the row."""

    slowest: float = 0.3
    fastest: float = 3.0
    level: float = 0.1

    def log(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `_LogLight`."""
        speed = self.slowest + (self.fastest - self.slowest) * self._share()
        return math.log(self.level) + speed * t, speed


@dataclass(frozen=True)
class Dark(ClosedLight):
    """A closed shutter: nothing but the sensor's own leak."""

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        return np.zeros(1), np.zeros(1)


_HALF_ROW_PX = 12.0


@dataclass(frozen=True)
class _Profiled(ClosedLight):
    """Light between 1 / `contrast` and 1 with edges of rms `blur_px`, moving at `speed_px_s`."""

    profile: Literal["blurred", "kinked"] = "kinked"
    blur_px: float = 0.6
    speed_px_s: float = 100.0
    contrast: float = 6.0

    @property
    @abstractmethod
    def duration_s(self) -> float:
        """Time to pass all pixels."""

    def _edge(self, x: Float64s) -> tuple[Float64s, Float64s]:
        """Return the edge from 0 to 1 at x, px, and its slope."""
        if self.profile == "blurred":
            z = x / self.blur_px
            return ndtr(z), np.exp(-z * z / 2) / (math.sqrt(2 * math.pi) * self.blur_px)
        half = self.blur_px * math.sqrt(3)
        return np.clip((x / half + 1) / 2, 0, 1), np.where(np.abs(x) < half, 0.5 / half, 0.0)


@dataclass(frozen=True)
class _Passing(_Profiled):
    @property
    def duration_s(self) -> float:
        """Time to pass all pixels."""
        return 2 * self._way_px / self.speed_px_s

    @property
    def _way_px(self) -> float:
        return _HALF_ROW_PX + 2 + 5 * self.blur_px

    def _place(self, t: Float64s) -> Float64s:
        return np.asarray(self.speed_px_s * t - self._way_px - _HALF_ROW_PX * (2 * self._share() - 1))


@dataclass(frozen=True)
class ShadedEdge(_Passing):
    """An edge between surfaces whose light varies by `shade` over `shade_px`."""

    shade: float = 0.05
    shade_px: float = 25.0

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        x, k, dark = self._place(t), 2 * math.pi / self.shade_px, 1 / self.contrast
        level, slope = self._edge(x)
        level, factor = dark + (1 - dark) * level, np.exp(self.shade * np.sin(k * x + 1))
        drift = level * self.shade * k * np.cos(k * x + 1)
        return level * factor, ((1 - dark) * slope + drift) * factor * self.speed_px_s


@dataclass(frozen=True)
class ThinLine(_Passing):
    """A bright line, `line_px` wide."""

    line_px: float = 1.0

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        x, dark = self._place(t), 1 / self.contrast
        (up, up_slope), (down, down_slope) = self._edge(x + self.line_px / 2), self._edge(x - self.line_px / 2)
        return dark + (1 - dark) * (up - down), (1 - dark) * (up_slope - down_slope) * self.speed_px_s


@dataclass(frozen=True)
class TurningBody(_Profiled):
    """An ellipse of 20 x 12 px with a texture of 9 px; `speed_px_s` is that of its ends. It makes half a turn."""

    @property
    def duration_s(self) -> float:
        """Time of half a turn."""
        return math.pi * 20 / self.speed_px_s

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        k, turn, dark = np.arange(self.pixels), self.speed_px_s / 20, 1 / self.contrast
        radius, angle = 8 + 16 * ((k * 0.618034) % 1), 2.399963 * k - turn * t
        x, y = radius * np.cos(angle), radius * np.sin(angle)
        vx, vy = turn * y, -turn * x
        far, steep = np.hypot(x / 20, y / 12), np.hypot(x / 400, y / 144)
        inward = (1 - far) * far / steep
        far_rate = (x * vx / 400 + y * vy / 144) / far
        steep_rate = (x * vx / 400**2 + y * vy / 144**2) / steep
        inward_rate = ((1 - 2 * far) * far_rate - inward * steep_rate) / steep
        level, slope = self._edge(inward)
        a, b = 2 * math.pi * x / 9 + 1, 2 * math.pi * y / 7
        texture = 0.75 + 0.25 * np.sin(a) * np.sin(b)
        texture_rate = 0.5 * math.pi * (vx / 9 * np.cos(a) * np.sin(b) + vy / 7 * np.sin(a) * np.cos(b))
        rate = slope * inward_rate * texture + level * texture_rate
        return dark + (1 - dark) * level * texture, (1 - dark) * rate


_IRRATIONAL = math.sqrt(2) - 1  # irrational: shares fill the interval evenly, and follow no pattern of a scene


@dataclass(frozen=True)
class Faded(ClosedLight):
    """Another scene that is dimmed at the start, each pixel by a share of a threshold of its own, until `rise_s`.

    Without that, a pixel whose light returns to where it began meets a level exactly where the light comes to rest, and
    rounding decides whether the ideal pixel fires.

    Attributes
    ----------
    scene : the scene; `pixels` is its own.
    threshold : the dimming is 0.1 to 0.9 of it, ln units.
    rise_s : end of the dimming, s; its derivative is continuous.
    """

    scene: ClosedLight = field(default_factory=lambda: MovingEdge())
    threshold: float = 0.2
    rise_s: float = 0.04

    def __post_init__(self) -> None:
        if self.pixels != self.scene.pixels:
            raise ValueError(f"{self.pixels} pixels: must be the {self.scene.pixels} of the scene")

    def jumps_s(self) -> Float64s:
        """See `ClosedLight`."""
        return self.scene.jumps_s()

    def light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """See `ClosedLight`."""
        depth = -self.threshold * (0.1 + 0.8 * ((np.arange(self.pixels) * _IRRATIONAL) % 1))
        phase = math.pi * np.clip(t / self.rise_s, 0, 1)
        dimming = np.exp(depth * (1 + np.cos(phase)) / 2)
        slope = -depth * np.sin(phase) * math.pi / (2 * self.rise_s)
        light, rate = self.scene.light(t)
        return light * dimming, (rate + light * slope) * dimming
