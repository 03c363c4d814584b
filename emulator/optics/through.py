"""A scene seen through a lens: radiance in, light on the pixels out.

In this order, all in linear light:

    the scene draws radiance, averaged over pixels       wider than the picture where the lens bends lines inwards
    blur                                                 point spread and defocus at the scene's distance
    bend                                                 distortion
    scale                                                light per radiance, cos^4 off the axis

The time derivative goes the same way: all of it is linear. A part that changes nothing is not there: a blur under
a tenth of a pixel, which moves no edge by more than a hundredth, and a distortion of zero.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.light import Light, Scene, SceneError
from emulator.optics.distortion import Distortion, DistortionError, straight_columns_and_rows
from emulator.optics.lens import Chip, LensParameters
from emulator.optics.passes import Bilinear, bend, blur, gaussian_taps, scale

__all__ = ["Through"]

_LEAST_BLUR_PX = 0.1


class Through(Scene):
    """The scene that `build` makes for a pinhole camera, seen through a lens on `chip`.

    Raises
    ------
    SceneError
        The lens folds the picture over itself; and whatever `build` raises.
    """

    def __init__(
        self, lens: LensParameters, chip: Chip, size: tuple[int, int], build: Callable[[Pinhole], Scene]
    ) -> None:
        self._size = size
        camera = lens.pinhole(size)
        places = _places(lens, camera)
        inner = camera if places is None else camera.widened(_margin_px(*places, camera))
        self.scene = build(inner)
        self._bent = None if places is None else _within(*places, inner)
        self._factor = _factor(lens, camera, places)
        sigma_px = lens.blur_sigma_px(chip, camera.focal_px, self.scene.distance_m)
        self._taps = gaussian_taps(sigma_px) if sigma_px >= _LEAST_BLUR_PX else None
        self.blur_sigma_px = sigma_px
        self._inner: tuple[Light, Light] | None = None
        if self._bent is not None:
            shape = inner.height, inner.width
            self._inner = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        self._room = np.zeros((inner.height, inner.width), np.float32) if self._taps is not None else None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """That of the scene: distortion stretches by a few percent, which the step rule has room for."""
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
    def renderer(self) -> str | None:
        """That of the scene."""
        return self.scene.renderer

    @property
    def counts(self) -> Mapping[str, int]:
        """Those of the scene."""
        return self.scene.counts

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light on the pixels at `t_ns` into `out`."""
        picture = out if self._inner is None else self._inner[0]
        self.scene.light(t_ns, picture)
        self._pass(picture, out)

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light on the pixels and its time derivative."""
        pictures = (light, rate) if self._inner is None else self._inner
        self.scene.light_and_rate(t_ns, *pictures)
        for picture, out in zip(pictures, (light, rate), strict=True):
            self._pass(picture, out)

    def close(self) -> None:
        """Close the scene."""
        self.scene.close()

    def _pass(self, picture: Light, out: Light) -> None:
        if self._taps is not None and self._room is not None:
            blur(picture, self._taps, self._room)
        if self._bent is not None:
            bend(picture, self._bent, out)
            picture = out
        scale(picture, self._factor, out)


_Places = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def _places(lens: LensParameters, camera: Pinhole) -> _Places | None:
    """Return where each pixel looks in a picture without distortion, from its middle, px; None without distortion."""
    if not lens.distorts:
        return None
    try:
        return straight_columns_and_rows(Distortion.of(lens), camera)
    except DistortionError as error:
        raise SceneError(f"camera.lens: {error}") from error


def _margin_px(columns: npt.NDArray[np.float64], rows: npt.NDArray[np.float64], camera: Pinhole) -> int:
    """Return how much wider the straight picture must be on each side for the bent one to lie within."""
    beyond = max(float(np.abs(columns).max()) - camera.width / 2, float(np.abs(rows).max()) - camera.height / 2)
    return max(0, math.ceil(beyond)) + 1


def _within(columns: npt.NDArray[np.float64], rows: npt.NDArray[np.float64], inner: Pinhole) -> Bilinear:
    return Bilinear(columns + inner.width / 2, rows + inner.height / 2, inner.size)


def _factor(lens: LensParameters, camera: Pinhole, places: _Places | None) -> npt.NDArray[np.float32]:
    """Return the light a unit of radiance for each pixel, (height, width)."""
    if places is None:
        places = np.meshgrid(
            np.arange(camera.width) + 0.5 - camera.width / 2, np.arange(camera.height) + 0.5 - camera.height / 2
        )
    tangent = np.hypot(*places) / camera.focal_px
    fall = (1 + tangent**2) ** -2.0 if lens.vignetting else np.ones_like(tangent)
    return np.asarray(lens.light_per_radiance * fall, np.float32)
