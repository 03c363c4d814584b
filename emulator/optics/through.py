"""A scene seen through a lens: radiance in, light on the pixels out.

The order is, all in linear light:

    the scene draws radiance, averaged over pixels       on a wider frame where the lens bends lines inwards
    blur                                                 point spread and defocus at the scene's distance: a separable
                                                         Gaussian, each tap its share of a pixel (erf), the frame's edge
                                                         repeated
    bend                                                 distortion: a bilinear look-up at positions computed once
    scale                                                light per radiance, cos^4 off the axis

The time derivative is processed in the same way: all of it is linear. A step without an effect is skipped: a blur under
a tenth of a pixel, which moves no edge by more than a hundredth, and a distortion of zero.

Blur and scale process a part of the frame only: the rest is black, or was processed before. Their loops run over rows
of float32 and become vectors; look-ups do not, and cost about 3 ns a pixel. Threads blur and scale large light frames:
each does a share of the rows, to the same bits as one thread.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numba import njit

from emulator.geometry.camera import Pinhole, Rays, SceneGeometry, Seen
from emulator.light import LastArrays, Light, OtherLight, Region, Scene, SceneError
from emulator.optics.lens import Chip, DistortionError, LensParameters, bent_rays, straight_columns_and_rows
from emulator.threads import ThreadPool, available_threads
from firmware_protocol.compiled import KernelCompiler, entry_of
from firmware_protocol.events import Float32s, Floats, Int32s

Part = tuple[int, int, int, int]
"""Rows and columns of a light frame: first row, last row, first column, last column, the last ones not included."""

_REACH_SIGMAS = 3.5
_entry = entry_of(__name__, error_model="python")
_strip_entry = entry_of(__name__, fastmath={"contract"})
_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy", "fastmath": {"contract"}, "_nrt": False}
# It counts no references, which would slow loops down.
_loop: Callable[[Callable[..., None]], Any] = njit(**_OPTIONS, pipeline_class=KernelCompiler)
_STRIP = 48  # rows that are blurred together: they stay in the second-level cache


def gaussian_taps(sigma_px: float) -> Float32s:
    """Return the shares of a Gaussian that fall on pixels -n to n, (2 n + 1,) float32, their sum 1."""
    n = max(1, math.ceil(_REACH_SIGMAS * sigma_px))
    edges = np.array([math.erf((k - 0.5) / (sigma_px * math.sqrt(2))) for k in range(-n, n + 2)])
    shares = np.diff(edges)
    return np.asarray(shares / shares.sum(), np.float32)


class Bilinear:
    """Positions between the pixels of a frame of `size` = (width, height), at columns and rows (height, width).

    Column 0.5 is the middle of the first pixel; positions beyond the frame are moved to its edge.
    """

    def __init__(self, columns: Floats, rows: Floats, size: tuple[int, int]) -> None:
        width, height = size
        x = np.clip(columns - 0.5, 0, width - 1)
        y = np.clip(rows - 0.5, 0, height - 1)
        x0, y0 = np.minimum(x.astype(np.int32), max(width - 2, 0)), np.minimum(y.astype(np.int32), max(height - 2, 0))
        self.first = np.asarray(y0 * width + x0, np.int32)
        self.along = np.asarray(x - x0, np.float32)
        self.down = np.asarray(y - y0, np.float32)
        self.width = width


@_entry
def _bend(picture: Float32s, first: Int32s, along: Float32s, down: Float32s, width: int, out: Float32s) -> None:
    for row in range(out.shape[0]):
        to = out[row]
        for column in range(to.size):
            i = first[row, column]
            x, y = along[row, column], down[row, column]
            upper = picture[i] + x * (picture[i + 1] - picture[i])
            lower = picture[i + width] + x * (picture[i + width + 1] - picture[i + width])
            to[column] = upper + y * (lower - upper)


def bend(picture: Float32s, places: Bilinear, out: Float32s) -> None:
    """Look a contiguous `picture` up at `places` into `out`, both 2-D and at least 2 x 2 pixels."""
    _bend(picture.reshape(-1), places.first, places.along, places.down, places.width, out)


@_loop
def _add_four(taps: Float32s, w: Float32s, x: Float32s, y: Float32s, z: Float32s, out: Float32s) -> None:
    """Add four rows, each by its tap, to `out`, in their order."""
    a, b = taps[0], taps[1]
    c, d = taps[2], taps[3]
    for k in range(out.size):
        out[k] = (((out[k] + a * w[k]) + b * x[k]) + c * y[k]) + d * z[k]


@_loop
def _blur_along(row: Float32s, taps: Float32s, columns: tuple[int, int], line: Float32s, out: Float32s) -> None:
    """Write the pass along a row; `line` is a work array for the row with its ends repeated."""
    first, last = columns
    reach, n = taps.size // 2, last - first
    before, after = max(reach - first, 0), max(last + reach - row.size, 0)
    length = n + 2 * reach
    for x in range(before):
        line[x] = row[0]
    inner, source = line[before : length - after], row[first - reach + before : last + reach - after]
    for x in range(inner.size):
        inner[x] = source[x]
    for x in range(length - after, length):
        line[x] = row[row.size - 1]
    out[:] = np.float32(0)
    for k in range(0, taps.size - 3, 4):
        second, third, fourth = line[k + 1 : k + 1 + n], line[k + 2 : k + 2 + n], line[k + 3 : k + 3 + n]
        _add_four(taps[k : k + 4], line[k : k + n], second, third, fourth, out)
    for k in range(taps.size // 4 * 4, taps.size):
        tap, shifted = taps[k], line[k : k + n]
        for x in range(n):
            out[x] += tap * shifted[x]


@_strip_entry
def _blur_and_scale(
    picture: Float32s, taps: Float32s, factor: Float32s, part: Part, strip: Float32s, out: Float32s
) -> None:
    """Write `picture` blurred by `taps` and times `factor` into `out`, in `part`; `strip` is a work array."""
    height, reach, size = picture.shape[0], taps.size // 2, taps.size
    first_row, last_row, left, right = part
    n = right - left
    ends, line = strip[-1], strip[-2, :n]
    for begin in range(first_row, last_row, _STRIP):
        end = min(begin + _STRIP, last_row)
        top, bottom = max(0, begin - reach), min(height, end + reach) - 1
        for y in range(top, bottom + 1):
            _blur_along(picture[y], taps, (left, right), ends, strip[y - top, :n])
        for y in range(begin, end):
            above = y - reach
            line[:] = np.float32(0)
            for k in range(0, size - 3, 4):
                i, j = min(max(above + k, 0), height - 1) - top, min(max(above + k + 1, 0), height - 1) - top
                m, o = min(max(above + k + 2, 0), height - 1) - top, min(max(above + k + 3, 0), height - 1) - top
                _add_four(taps[k : k + 4], strip[i, :n], strip[j, :n], strip[m, :n], strip[o, :n], line)
            for k in range(size // 4 * 4, size):
                tap, row = taps[k], strip[min(max(above + k, 0), height - 1) - top, :n]
                for x in range(n):
                    line[x] += tap * row[x]
            by, to = factor[y, left:right], out[y, left:right]
            for x in range(n):
                to[x] = line[x] * by[x]


_WORTH_A_THREAD = 200_000
"""Pixels whose blur takes several times as long as starting a thread."""


class BlurWorkers:
    """Blur by `taps`, then scale by `factor`, (height, width); `threads` share large parts, 0: those available."""

    def __init__(self, taps: Float32s, factor: Float32s, threads: int = 0) -> None:
        self._taps, self._factor = taps, factor
        self._pool = ThreadPool(threads or available_threads())
        strip = _STRIP + taps.size + 1, factor.shape[1] + taps.size
        self._strips = [np.zeros(strip, np.float32) for _ in range(self._pool.threads)]

    def __call__(self, pictures: Sequence[Float32s], part: Part, outs: Sequence[Float32s]) -> None:
        """Write `pictures`, blurred and scaled, to `outs`, in `part`."""
        first, last, left, right = part
        large = len(outs) * (last - first) * (right - left) >= _WORTH_A_THREAD
        count = self._pool.threads if large else 1
        rows = [first + (last - first) * k // count for k in range(count + 1)]

        def share(k: int, thread: int) -> None:
            number, k = divmod(k, count)
            part = rows[k], rows[k + 1], left, right
            _blur_and_scale(pictures[number], self._taps, self._factor, part, self._strips[thread], outs[number])

        if count > 1:  # threads take shares in turn: one on a busy core does not hold up all
            self._pool.each(share, count * len(outs))
            return
        for k in range(len(outs)):
            share(k, 0)

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()


_LEAST_BLUR_PX = 0.1


class Through(OtherLight):
    """The scene that `build` makes for a pinhole camera, seen through a lens on `chip`; `threads` as in `BlurWorkers`.

    Raises SceneError where the lens folds the image over itself; also errors of `build`.
    """

    def __init__(
        self,
        lens: LensParameters,
        chip: Chip,
        size: tuple[int, int],
        build: Callable[[Pinhole], Scene],
        threads: int = 0,
    ) -> None:
        camera = lens.pinhole(size)
        places = _places(lens, camera)
        inner = camera
        if places is not None:  # a bent image needs light from beyond the edges of a straight one
            beyond_px = np.abs(places).max(axis=(1, 2)) - np.array([camera.width, camera.height]) / 2
            margin_px = math.ceil(max(0, *beyond_px)) + 1
            inner = Pinhole(camera.width + 2 * margin_px, camera.height + 2 * margin_px, camera.focal_px)
        super().__init__(build(inner))
        self.size = size
        middle = inner.width / 2, inner.height / 2
        self._bent = None if places is None else Bilinear(places[0] + middle[0], places[1] + middle[1], inner.size)
        self._rays = None if places is None else bent_rays(lens, places[0], places[1], inner)
        self._factor = _factor(lens, camera, places)
        sigma_px = lens.blur_sigma_px(chip, camera.focal_px, self.scene.distance_m)
        self._taps = gaussian_taps(sigma_px) if sigma_px >= _LEAST_BLUR_PX else None
        self.blur_sigma_px = sigma_px
        self._reach_px = 0 if self._taps is None else self._taps.size // 2
        shape = inner.height, inner.width
        self._inner = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
        blurs_last = self._factor if self._bent is None else np.ones(shape, np.float32)
        self._workers = None if self._taps is None else BlurWorkers(self._taps, blurs_last, threads)
        self._blurred = [np.zeros(shape, np.float32) for _ in range(2)] if self._bent is not None else []
        self._arrays = LastArrays()

    def geometry(self, rays: Rays | None = None) -> SceneGeometry | None:
        """Return the geometry of the scene, along the rays that the lens bends."""
        return self.scene.geometry(rays or self._rays)

    def flow(self, out: Seen) -> bool:
        """Write the flow of the scene's last frame, unless the lens bends it."""
        return self._bent is None and self.scene.flow(out)

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
        super().close()
        if self._workers is not None:
            self._workers.close()

    def _pass(self, outs: tuple[Light, ...]) -> None:
        """Apply the lens to the light of the scene, where it may differ from the contents of `outs`."""
        changed = self.scene.changed if self._arrays.are(*outs) and self._bent is None else None
        self.changed = None if changed is None else changed.grown(self._reach_px, self.size)
        if self.changed is not None and self.changed.empty:
            return
        part = (self.changed or Region(0, self.size[1], 0, self.size[0])).bounds
        pictures: Sequence[Light] = self._inner[: len(outs)]
        if self._bent is None and self._workers is not None:
            self._workers(pictures, part, outs)
            return
        if self._workers is not None:
            height, width = pictures[0].shape
            self._workers(pictures, (0, height, 0, width), self._blurred[: len(outs)])
            pictures = self._blurred
        for picture, out in zip(pictures, outs, strict=False):
            if self._bent is not None:
                bend(picture, self._bent, out)
            first_row, last_row, first, last = part
            within = slice(first_row, last_row), slice(first, last)
            source = picture if self._bent is None else out
            np.multiply(source[within], self._factor[within], out=out[within])


def _places(lens: LensParameters, camera: Pinhole) -> Floats | None:
    """Return columns and rows of pixels in a frame without distortion, from its middle; None without distortion."""
    if not any((lens.k1, lens.k2, lens.k3, lens.p1, lens.p2)):
        return None
    try:
        return np.array(straight_columns_and_rows(lens, camera))
    except DistortionError as error:
        raise SceneError(f"camera.lens: {error}") from error


def _factor(lens: LensParameters, camera: Pinhole, places: Floats | None) -> Float32s:
    """Return the light a unit of radiance for each pixel, (height, width)."""
    if places is None:
        columns, rows = (np.arange(n) + 0.5 - n / 2 for n in (camera.width, camera.height))
        places = np.array(np.meshgrid(columns, rows))
    tangent = np.hypot(*places) / camera.focal_px
    fall = (1 + tangent**2) ** -2.0 if lens.vignetting else np.ones_like(tangent)
    return np.asarray(lens.light_per_radiance * fall, np.float32)
