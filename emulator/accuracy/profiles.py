"""Light of edges with a profile of their own, in closed form: where a cubic in log light is hard pressed.

A profile is "blurred", a Gaussian edge, or "kinked", a linear ramp of the same rms, which is what averaging over a
pixel makes of a sharp edge without blur. Light is flat or nearly so, and an edge enters within a step.

    ShadedEdge     an edge between two surfaces whose light drifts by some per cent
    ThinLine       a bright line of 1 px
    TurningBody    a textured ellipse that turns before a dim sky
"""

from __future__ import annotations

import math
from abc import abstractmethod
from dataclasses import dataclass
from typing import Literal

import numpy as np
import numpy.typing as npt
from scipy.special import ndtr

from emulator.accuracy.light import ClosedLight, Float64s

__all__ = ["ShadedEdge", "ThinLine", "TurningBody"]

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
        """How long it takes to pass all pixels."""

    def _edge(self, x: Float64s) -> tuple[Float64s, Float64s]:
        """Return the edge from 0 to 1 at x, px, and its slope."""
        if self.profile == "blurred":
            z = x / self.blur_px
            return ndtr(z), np.exp(-z * z / 2) / (math.sqrt(2 * math.pi) * self.blur_px)
        half = self.blur_px * math.sqrt(3)
        return np.clip((x / half + 1) / 2, 0, 1), np.where(np.abs(x) < half, 0.5 / half, 0.0)

    def value(self, t_s: npt.ArrayLike) -> Float64s:
        """See `ClosedLight`."""
        return self._light(np.atleast_1d(np.asarray(t_s, np.float64))[:, None])[0]

    def rate(self, t_s: npt.ArrayLike) -> Float64s:
        """See `ClosedLight`."""
        return self._light(np.atleast_1d(np.asarray(t_s, np.float64))[:, None])[1]

    @abstractmethod
    def _light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        """Return light and rate, (m, pixels), at times (m, 1), s."""


@dataclass(frozen=True)
class _Passing(_Profiled):
    @property
    def duration_s(self) -> float:
        """How long it takes to pass all pixels."""
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

    def _light(self, t: Float64s) -> tuple[Float64s, Float64s]:
        x, k, dark = self._place(t), 2 * math.pi / self.shade_px, 1 / self.contrast
        level, slope = self._edge(x)
        level, factor = dark + (1 - dark) * level, np.exp(self.shade * np.sin(k * x + 1))
        drift = level * self.shade * k * np.cos(k * x + 1)
        return level * factor, ((1 - dark) * slope + drift) * factor * self.speed_px_s


@dataclass(frozen=True)
class ThinLine(_Passing):
    """A bright line, `line_px` wide."""

    line_px: float = 1.0

    def _light(self, t: Float64s) -> tuple[Float64s, Float64s]:
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

    def _light(self, t: Float64s) -> tuple[Float64s, Float64s]:
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
