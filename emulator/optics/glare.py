"""Veiling glare: light that a lens scatters over the whole image, by reflections between its surfaces and its barrel.

    light on a pixel    (1 - g) E + g M        E: of the image, M: mean of E over all pixels

g is the veiling glare index of ISO 9358: the light in the image of a small black area within a uniform bright field,
over that of the field. What is scattered is missing in the image, so a uniform field and the mean stay as they are.
Usual lenses are taken to lie between 0.5 and 5 %, good ones below 1 %: not verified, no public table was found
(imatest.com/docs/veilingglare describes the measurement). Left out: the halo around a bright light, ghost images, and
light from beyond the edge of the image.

The veil follows the light exactly at each frame, with its time derivative. Between two frames the mean is the cubic
through both values and derivatives, so the light of a single pixel there is off by at most g D h^4 / 384 for a step h,
D the greatest fourth derivative of M. Derivatives that are not known count as 0 in the mean's.

Any change of light changes all pixels, so the changed region is the whole frame unless it is empty: the sensor cannot
skip still pixels. That, and two passes over each frame (0.5 ns a pixel for light and derivative), are its cost.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Literal, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Rays, SceneGeometry
from emulator.light import Light, PixelLight, Region, Scene
from emulator.optics.lens import LensParameters
from firmware_protocol.compiled import entry_of


def veiled(scene: Scene, lens: LensParameters) -> Scene:
    """Return a scene with the veiling glare of its lens: the scene itself where the lens has none."""
    return Veiled(scene, lens.veiling_glare) if lens.veiling_glare else scene


_LARGEST = np.finfo(np.float32).max
_entry = entry_of(__name__, nogil=True, error_model="numpy", fastmath={"contract"})


@_entry
def _mean_of(values: Light, sums: npt.NDArray[np.float64], least: np.float32) -> float:
    """Return the mean of an array; values below `least` count as that, those that are not finite as 0.

    Columns are summed first, into `sums`, (width,): such a loop becomes vectors, and has one order on every machine.
    """
    for x in range(sums.size):
        sums[x] = 0.0
    for y in range(values.shape[0]):
        row = values[y]
        for x in range(sums.size):
            e = row[x]
            sums[x] += (e if e > least else least) if abs(e) <= _LARGEST else np.float32(0)
    total = 0.0
    for x in range(sums.size):
        total += sums[x]
    return total / values.size


@_entry
def _add_veil(values: Light, share: np.float32, veil: np.float32, out: Light) -> None:
    """Write share * values + veil to `out`."""
    for y in range(values.shape[0]):
        row, to = values[y], out[y]
        for x in range(row.size):
            to[x] = row[x] * share + veil


class _Mean(NamedTuple):
    """Mean light of a frame, and its time derivative, a second."""

    t_ns: int
    light: float
    rate: float


def _between(first: _Mean, last: _Mean, t_ns: int) -> tuple[float, float]:
    """Return the mean light and its derivative at a time between two frames."""
    h_s = (last.t_ns - first.t_ns) * 1e-9
    if h_s <= 0:
        return last.light, last.rate
    z, rise = (t_ns - first.t_ns) * 1e-9 / h_s, last.light - first.light
    a0, a1 = first.rate * h_s, last.rate * h_s
    c2, c3 = 3 * rise - 2 * a0 - a1, a0 + a1 - 2 * rise
    return first.light + ((c3 * z + c2) * z + a0) * z, ((3 * c3 * z + 2 * c2) * z + a0) / h_s


class Veiled(Scene):
    """A scene with veiling glare.

    Parameters
    ----------
    scene : Scene
        The scene, in light on the pixels; closed with this one.
    glare : float
        The veiling glare index, 0 to 1.

    Attributes
    ----------
    scene : Scene
        As given.
    """

    def __init__(self, scene: Scene, glare: float) -> None:
        self.scene = scene
        self._size, self._glare = scene.size, glare
        shape = self._size[::-1]
        self._inner = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._sums = np.zeros(self._size[0])
        self._before = self._last = _Mean(0, 0.0, 0.0)
        self._outs: tuple[Light, ...] = ()
        self._changed: Region | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """That of the scene: the veil has no edges that move."""
        return self.scene.motion_bound_px_s

    @property
    def distance_m(self) -> float:
        """That of the scene."""
        return self.scene.distance_m

    @property
    def notes(self) -> tuple[str, ...]:
        """Those of the scene."""
        return self.scene.notes

    @property
    def painter(self) -> Literal["cpu", "gl"]:
        """That of the scene."""
        return self.scene.painter

    @property
    def renderer(self) -> str | None:
        """That of the scene."""
        return self.scene.renderer

    @property
    def counts(self) -> Mapping[str, int]:
        """Those of the scene."""
        return self.scene.counts

    @property
    def has_rate(self) -> bool:
        """That of the scene."""
        return self.scene.has_rate

    @property
    def changed(self) -> Region | None:
        """The empty region if nothing changed; else all of the frame."""
        return self._changed

    @property
    def pixel_light(self) -> PixelLight | None:
        """The function of the scene, with the veil between the last two frames that were drawn."""
        inner = self.scene.pixel_light
        return None if inner is None else partial(self._pixels, inner)

    def stop(self) -> None:
        """Limit the time of the present light frame of the scene."""
        self.scene.stop()

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene."""
        return self.scene.geometry(rays)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns` into `out`."""
        self.scene.light(t_ns, self._inner[0])
        self._veil(t_ns, (out,))

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative."""
        self.scene.light_and_rate(t_ns, *self._inner)
        self._veil(t_ns, (light, rate))

    def close(self) -> None:
        """Close the scene."""
        self.scene.close()

    def _veil(self, t_ns: int, outs: tuple[Light, ...]) -> None:
        """Write the light of the scene, with its veil, to `outs`; nothing where they have it already."""
        known = len(outs) == len(self._outs) and all(a is b for a, b in zip(outs, self._outs, strict=True))
        changed, self._outs = self.scene.changed, outs
        still = known and changed is not None and changed.empty
        self._changed = changed if still else None
        self._before, self._last = self._last, self._mean(t_ns, len(outs), still)
        if still:
            return
        for values, mean, out in zip(self._inner, self._last[1:], outs, strict=False):
            _add_veil(values, np.float32(1 - self._glare), np.float32(self._glare * mean), out)

    def _mean(self, t_ns: int, arrays: int, still: bool) -> _Mean:
        if still:
            return self._last._replace(t_ns=t_ns)
        light, rate = self._inner
        mean = float(_mean_of(light, self._sums, np.float32(0)))
        rate_s = float(_mean_of(rate, self._sums, -_LARGEST)) if arrays == 2 else 0.0
        return _Mean(t_ns, mean, rate_s)

    def _pixels(self, inner: PixelLight, t_ns: int, pixels: npt.NDArray[np.int64]) -> tuple[Light, Light]:
        """Return the light and rate of single pixels between the last two frames."""
        share = np.float32(1 - self._glare)
        means = _between(self._before, self._last, t_ns)
        light, rate = (
            values * share + np.float32(self._glare * mean)
            for values, mean in zip(inner(t_ns, pixels), means, strict=True)
        )
        return light, rate
