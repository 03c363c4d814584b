"""Effects of any imager on light: efficiency, fixed pattern, dark current of each pixel, and shot noise.

The pixel computes the log of a photocurrent i = E + dark. This module replaces E by E' so that

    i' = (g E + dark_p) e^m        g    efficiencies times the pixel's gain, normal around 1 (PRNU)
                                   dark_p   the pixel's dark current, log-normal (DCNU), mean `dark_current_relative`
                                   m    shot noise

The array gets the least dark current of all pixels; the rest of each pixel's own is part of E'.

Shot noise. Over a time G a pixel counts N = electrons i G, with the relative deviation s = 1 / sqrt(N). Photoelectrons
and dark electrons are counted together, as the sum of two Poisson numbers is one; either's share of s^2 can be left
out. On a fixed grid of times k G every pixel has a keyed normal number n_k, and between two of them, at the share x,

    m = s ((1 - x) n_k + x n_(k+1)) - s^2 ((1 - x)^2 + x^2) / 2

with s for the light at that moment; the last term preserves the mean current. m is a straight line in the *log* of the
light, and pixels interpolate light in the same way. So the result does not depend on the ends of steps, except that
every grid time must be one: `Sensor` cuts steps there. Noise faster than the grid belongs to `noise`, whose rms is that
of the whole bandwidth; slower than the grid, the spectrum is that of counting.
"""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import numpy as np

from emulator.light import LightFrame, PixelLight
from emulator.sensor.numerics.compiled import cached_entry, vector_kernel
from emulator.sensor.numerics.elementary import decay, natural_log
from emulator.sensor.numerics.keyed import Purpose, normal, normals, root_of, streams
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Float32s, Int64s

_LEAST_GAIN = 0.1
_LARGEST = np.finfo(np.float32).max
_ARRAY_SHARE = 0.01  # of the dark current, given to the array when counting can reduce it
_ZERO, _ONE, _HALF = (np.float32(x) for x in (0, 1, 0.5))


class _Pattern(NamedTuple):
    """The fixed pattern of gains and dark currents, (pixels,), and the dark current that the array adds by itself."""

    gain: Float32s
    dark: Float32s
    least: np.float32


class _Counting(NamedTuple):
    """The normal numbers of the grid times before and after, the share x between them, and their scale."""

    n0: Float32s
    n1: Float32s
    x: np.float32
    per_count: np.float32  # 1 / (electrons G)
    of_light: np.float32  # 0 or 1, share in s^2
    of_dark: np.float32


@vector_kernel
def _shine(light: Float32s, gain: Float32s, dark: Float32s, out: Float32s) -> None:
    """Write g E + dark into `out`; light below 0 counts as 0, light that is not finite stays so."""
    for k in range(out.size):
        e = light[k]
        lit = e if e > _ZERO else _ZERO
        out[k] = lit * gain[k] + dark[k] if abs(e) <= _LARGEST else e


@vector_kernel
def _power(exponent: np.float32) -> np.float32:
    """Return e^exponent, within 6e-7 of it."""
    below_one: np.float32 = _ONE - decay(abs(exponent))  # e^-|exponent|
    return below_one if exponent < _ZERO else _ONE / below_one


@vector_kernel
def _count(current: Float32s, dark: Float32s, c: _Counting) -> None:
    """Multiply currents by e^m, in place."""
    left, right = _ONE - c.x, c.x
    spread = _HALF * (left * left + right * right)
    for k in range(current.size):
        i = current[k]
        counted = c.of_light * (i - dark[k]) + c.of_dark * dark[k]
        variance = c.per_count * counted / (i * i)
        m = np.sqrt(variance) * (left * c.n0[k] + right * c.n1[k]) - variance * spread
        current[k] = i * _power(m)


@vector_kernel
def _without(least: np.float32, out: Float32s) -> None:
    """Subtract the dark current that the array adds, limited to 0; NaN stays."""
    for k in range(out.size):
        e = out[k] - least
        out[k] = _ZERO if e < _ZERO else e


@vector_kernel
def _interpolate(before: Float32s, after: Float32s, dark: np.float32, share: np.float32, out: Float32s) -> None:
    for k in range(out.size):
        e0, e1 = before[k], after[k]
        first, last = (e0 if e0 > _ZERO else _ZERO) + dark, (e1 if e1 > _ZERO else _ZERO) + dark
        between = first * _power(share * natural_log(last / first)) - dark
        moves = (abs(e0) <= _LARGEST) & (abs(e1) <= _LARGEST) & (e0 != e1)
        out[k] = between if moves else e1


@cached_entry
def part_of_the_way(before: Float32s, after: Float32s, dark: np.float32, share: np.float32, out: Float32s) -> None:
    """Write the light between two frames into `out`, all (pixels,): linear in the log of light + dark.

    Where either frame is not finite, the result is the later one.
    """
    _interpolate(before, after, dark, share, out)


@cached_entry
def _see(light: Float32s, p: _Pattern, out: Float32s) -> None:
    _shine(light, p.gain, p.dark, out)
    _without(p.least, out)


@cached_entry
def _see_counted(light: Float32s, p: _Pattern, c: _Counting, out: Float32s) -> None:
    _shine(light, p.gain, p.dark, out)
    _count(out, p.dark, c)
    _without(p.least, out)


class Imager:
    """The imager in front of an array.

    Parameters
    ----------
    parameters : the sensor.
    seed : keys gains, dark currents and counts.

    Attributes
    ----------
    works : false if the imager does not change the light.
    dark_current_relative : dark current that the array must add to E' to get i'.
    grid_ns : length G of the grid; 0 without shot noise.
    """

    def __init__(self, parameters: SensorParameters, seed: int) -> None:
        p, pixel = parameters.imager, np.arange(parameters.width * parameters.height)
        gain = np.maximum(1 + p.prnu * normal(seed, Purpose.PHOTO_RESPONSE, pixel), _LEAST_GAIN)
        dark = np.exp(p.dcnu * normal(seed, Purpose.DARK_CURRENT, pixel) - p.dcnu**2 / 2)
        dark *= parameters.dark_current_relative
        counts = p.photon_shot_noise or p.dark_shot_noise
        self.works = counts or p.prnu > 0 or p.dcnu > 0 or p.system_efficiency * p.quantum_efficiency != 1
        self.dark_current_relative = float(dark.min()) * (_ARRAY_SHARE if counts else 1.0)
        self.grid_ns = p.shot_grid_us * 1000 if counts else 0
        self._parameters = p
        efficient = (gain * p.system_efficiency * p.quantum_efficiency).astype(np.float32)
        self._pattern = _Pattern(efficient, dark.astype(np.float32), np.float32(self.dark_current_relative))
        self._out = np.empty((parameters.height, parameters.width), np.float32)
        if counts:
            self._streams = streams(root_of(seed, Purpose.SHOT_NOISE), pixel.size)
            self._grid, self._drawn = -2, (np.empty(0, np.float32), np.empty(0, np.float32))

    def see(self, frame: LightFrame) -> LightFrame:
        """Return `frame` with E' in the place of light; valid until the next call.

        Shot noise has no time derivative, no light between frames, and changes all pixels in each frame.
        """
        if not self.works:
            return frame
        flat, out = np.ascontiguousarray(frame.light).reshape(-1), self._out.reshape(-1)
        if self.grid_ns:
            _see_counted(flat, self._pattern, self._counting(frame.t_ns), out)
            return LightFrame(frame.t_ns, self._out)
        _see(flat, self._pattern, out)
        rate = None if frame.rate is None else frame.rate * self._pattern.gain.reshape(frame.rate.shape)
        at = None if frame.at is None else partial(_see_pixels, frame.at, self._pattern)
        return replace(frame, light=self._out, rate=rate, at=at)

    def _counting(self, t_ns: int) -> _Counting:
        p, grid = self._parameters, t_ns // self.grid_ns
        if grid != self._grid:
            before = self._drawn[1] if grid == self._grid + 1 else normals(self._streams, grid)
            self._grid, self._drawn = grid, (before, normals(self._streams, grid + 1))
        x = (t_ns - grid * self.grid_ns) / self.grid_ns
        electrons = p.electrons_per_s_at_reference * p.shot_grid_us * 1e-6
        shares = np.float32(p.photon_shot_noise), np.float32(p.dark_shot_noise)
        return _Counting(*self._drawn, np.float32(x), np.float32(1 / electrons), *shares)


def _see_pixels(at: PixelLight, p: _Pattern, t_ns: int, pixels: Int64s) -> tuple[Float32s, Float32s]:
    """Return E' of single pixels and its time derivative, as `Imager.see` does for a whole frame."""
    light, rate = at(t_ns, pixels)
    pattern, seen = _Pattern(p.gain[pixels], p.dark[pixels], p.least), np.empty(pixels.size, np.float32)
    _see(light, pattern, seen)
    return seen, rate * pattern.gain
