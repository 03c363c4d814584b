"""A scene seen through a lens: radiance in, light on the pixels out.

The order is, all in linear light:

    the scene draws radiance, averaged over pixels       on a wider frame where the lens bends lines inwards
    blur                                                 point spread and defocus at the scene's distance
    bend                                                 distortion
    scale                                                light per radiance, cos^4 off the axis

The time derivative is processed in the same way: all of it is linear. A step without an effect is skipped: a blur under
a tenth of a pixel, which moves no edge by more than a hundredth, and a distortion of zero.

Threads blur and scale large light frames: each does a share of the rows, to the same bits as one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Literal

import numpy as np
import numpy.typing as npt

from emulator.geometry.camera import Pinhole, Rays, SceneGeometry
from emulator.light import Light, PixelLight, Region, Scene, SceneError
from emulator.optics.lens import Chip, Distortion, DistortionError, LensParameters, bent_rays, straight_columns_and_rows
from emulator.optics.passes import Bilinear, Part, bend, blur, blur_and_scale, gaussian_taps, scale, strip_for
from emulator.threads import ThreadPool, available_threads

_WORTH_A_THREAD = 200_000
"""Pixels whose blur takes several times as long as starting a thread."""

_Float32s = npt.NDArray[np.float32]


class BlurWorkers:
    """Blur by `taps`, then scale by `factor`, (height, width), of light frames of that size.

    Parameters
    ----------
    threads : number of threads for a large part; 0: those available.
    """

    def __init__(self, taps: _Float32s, factor: _Float32s, threads: int = 0) -> None:
        self._taps, self._factor = taps, factor
        self._pool = ThreadPool(threads or available_threads())
        self._strips = [strip_for(factor.shape[1], taps) for _ in range(self._pool.threads)]

    def __call__(self, pictures: Sequence[_Float32s], part: Part, outs: Sequence[_Float32s]) -> None:
        """Write `pictures`, blurred and scaled, to `outs`, in `part`."""
        first, last, left, right = part
        large = len(outs) * (last - first) * (right - left) >= _WORTH_A_THREAD
        count = self._pool.threads if large else 1
        rows = [first + (last - first) * k // count for k in range(count + 1)]

        def share(k: int, thread: int) -> None:
            which, k = divmod(k, count)
            mine = rows[k], rows[k + 1], left, right
            blur_and_scale(pictures[which], self._taps, self._factor, mine, self._strips[thread], outs[which])

        if count > 1:  # threads take shares in turn: one on a busy core does not hold up all
            self._pool.each(share, count * len(outs))
            return
        for k in range(len(outs)):
            share(k, 0)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()


_LEAST_BLUR_PX = 0.1


class Through(Scene):
    """The scene that `build` makes for a pinhole camera, seen through a lens on `chip`.

    Parameters
    ----------
    threads : number of threads that blur, as in `BlurWorkers`.

    Raises
    ------
    SceneError
        The lens folds the image over itself; also errors of `build`.
    """

    def __init__(
        self,
        lens: LensParameters,
        chip: Chip,
        size: tuple[int, int],
        build: Callable[[Pinhole], Scene],
        threads: int = 0,
    ) -> None:
        self._size = size
        camera = lens.pinhole(size)
        places = _places(lens, camera)
        inner = camera if places is None else camera.widened(_margin_px(*places, camera))
        self.scene = build(inner)
        self._bent = None if places is None else _within(*places, inner)
        self._rays = None if places is None else bent_rays(Distortion.of(lens), places, inner)
        self._factor = _factor(lens, camera, places)
        sigma_px = lens.blur_sigma_px(chip, camera.focal_px, self.scene.distance_m)
        self._taps = gaussian_taps(sigma_px) if sigma_px >= _LEAST_BLUR_PX else None
        self.blur_sigma_px = sigma_px
        shape = inner.height, inner.width
        self._inner = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        straight = self._bent is None and self._taps is not None
        self._workers = BlurWorkers(self._taps, self._factor, threads) if self._taps is not None and straight else None
        room = shape if self._workers is None else (0, 0)
        self._blurred = np.zeros(room, np.float32)
        self._rows = np.zeros(room, np.float32)
        self._outs: tuple[Light, ...] = ()
        self._changed: Region | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """The bound of the scene: distortion stretches by a few percent, within the margin of the step rule."""
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
        """The changed region of the scene, wider by the blur; None, where the lens bends lines."""
        return self._changed

    @property
    def pixel_light(self) -> PixelLight | None:
        """The function of the scene, averaged over the blur; None where the lens bends lines."""
        inner = self.scene.pixel_light
        return None if inner is None or self._bent is not None else partial(self._pixels, inner)

    def stop(self) -> None:
        """Limit the time of the present light frame of the scene."""
        self.scene.stop()

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene, along the rays that the lens bends."""
        return self.scene.geometry(rays or self._rays)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light on the pixels at `t_ns` into `out`."""
        self.scene.light(t_ns, self._inner[0])
        self._pass((out,))

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light on the pixels and its time derivative."""
        self.scene.light_and_rate(t_ns, *self._inner)
        self._pass((light, rate))

    def close(self) -> None:
        """Close the scene and end the threads."""
        self.scene.close()
        if self._workers is not None:
            self._workers.close()

    def _pass(self, outs: tuple[Light, ...]) -> None:
        """Apply the lens to the light of the scene, where it may differ from the contents of `outs`."""
        whole = Region(0, self._size[1], 0, self._size[0])
        known = len(outs) == len(self._outs) and all(a is b for a, b in zip(outs, self._outs, strict=True))
        self._outs = outs
        changed = self.scene.changed if known and self._bent is None else None
        self._changed = None if changed is None else changed.grown(self._reach_px, self._size)
        part = (self._changed or whole).bounds if self._changed is None or not self._changed.empty else None
        if part is None:
            return
        pictures = self._inner[: len(outs)]
        if self._workers is not None:
            self._workers(pictures, part, outs)
            return
        for picture, out in zip(pictures, outs, strict=True):
            self._pass_one(picture, part, out)

    @property
    def _reach_px(self) -> int:
        return 0 if self._taps is None else self._taps.size // 2

    def _pass_one(self, picture: Light, part: Part, out: Light) -> None:
        if self._taps is not None:
            blur(picture, self._taps, self._rows, self._blurred, (0, picture.shape[0], 0, picture.shape[1]))
            picture = self._blurred
        if self._bent is not None:
            bend(picture, self._bent, out)
            picture = out
        scale(picture, self._factor, part, out)

    def _pixels(self, inner: PixelLight, t_ns: int, pixels: npt.NDArray[np.int64]) -> tuple[Light, Light]:
        """Return the light and rate of single pixels: of the scene's pixels around each, weighted by the blur."""
        width, height = self._size
        rows, columns = np.divmod(pixels, width)
        reach, factor = self._reach_px, self._factor.reshape(-1)[pixels]
        away = np.arange(-reach, reach + 1)
        near_rows = np.clip(rows[:, None] + away, 0, height - 1)
        near_columns = np.clip(columns[:, None] + away, 0, width - 1)
        around = (near_rows[:, :, None] * width + near_columns[:, None, :]).reshape(-1)
        wanted, place = np.unique(around, return_inverse=True)
        taps = np.ones(1, np.float32) if self._taps is None else self._taps
        shares = np.outer(taps, taps).reshape(-1)
        light, rate = (values[place].reshape(len(pixels), -1) @ shares * factor for values in inner(t_ns, wanted))
        return light, rate


_Places = tuple[npt.NDArray[np.float64], npt.NDArray[np.float64]]


def _places(lens: LensParameters, camera: Pinhole) -> _Places | None:
    """Return the position of each pixel in a frame without distortion, from its middle, px; None without distortion."""
    if not lens.distorts:
        return None
    try:
        return straight_columns_and_rows(Distortion.of(lens), camera)
    except DistortionError as error:
        raise SceneError(f"camera.lens: {error}") from error


def _margin_px(columns: npt.NDArray[np.float64], rows: npt.NDArray[np.float64], camera: Pinhole) -> int:
    """Return the margin on each side by which the frame without distortion must be wider to contain the bent one."""
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
