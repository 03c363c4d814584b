"""Scattered light of a lens: a veil over the whole image, and a halo about each source.

    light on a pixel    (1 - g - s) E + g M + s (H * E)        E: of the image, M: mean of E over all pixels

g is the veiling glare index of ISO 9358: the light in the image of a small black area within a uniform bright field,
over that of the field; reflections between surfaces and barrel spread it evenly. s is what rough and dirty surfaces
scatter by small angles, H its share at a distance of r pixels, to the height and the width of the image,

    H ~ (1 + (r / r0)^2)^(-p / 2)

the law of Harvey and Shack for polished surfaces: knees r0 of 0.1 mrad to 10 mrad and powers p of 0.5 to 2, above 2.5
for the best polish (Photon Engineering, help of FRED, "Harvey-Shack"). What is scattered is missing in the image, so a
uniform field and the mean stay as they are. Usual lenses are taken to lie between 0.5 and 5 % in all, good ones below
1 %: not verified, no public table was found (imatest.com/docs/veilingglare describes the measurement). Left out: ghost
images, and light from beyond the edge of the image, where the image is taken to go on as its mirror image.

Both are one cosine transform of means over cells: of 4 x 4 pixels with a halo, which is flatter than its law within two
cells of a source, else over the image. It follows the light exactly at each frame, with its time derivative. Unknown
derivatives count as 0. Any change of light changes all pixels, so the sensor cannot skip still pixels. That, and passes
over each frame (1 ns a pixel for light and derivative, 10 to 18 with a halo), are its cost.
"""

from __future__ import annotations

import numpy as np

from emulator.light import LastArrays, Light, OtherLight, Scene
from emulator.optics.lens import LensParameters
from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Floats

_CELL_PX = 4
_WITHIN = 8  # places across a cell at which the law of the halo is taken


def veiled(scene: Scene, lens: LensParameters) -> Scene:
    """Return a scene with the scattered light of its lens: the scene itself where the lens has none."""
    return Veiled(scene, lens) if lens.veiling_glare + lens.halo else scene


_LARGEST = np.finfo(np.float32).max
_entry = entry_of(__name__, nogil=True, error_model="numpy", fastmath={"contract"})


@kernel
def _place(pixel: int, pixels: int, cells: int) -> float:
    """Return the place of a pixel's middle between the middles of cells, 0 to cells - 1."""
    return min(max((pixel + 0.5) * cells / pixels - 0.5, 0.0), cells - 1.0)


@kernel
def _reach(cell: int, pixels: int, cells: int) -> tuple[int, int]:
    """Return the first pixel that counts in a cell, and the first beyond."""
    first, beyond = (cell - 0.5) * pixels / cells - 0.5, (cell + 1.5) * pixels / cells - 0.5
    return max(int(np.ceil(first)), 0), min(int(np.floor(beyond)) + 1, pixels)


@_entry
def _cell_means(values: Light, least: np.float32, sums: Floats, means: Floats) -> None:
    """Write means about the middles of cells; values below `least` count as that, those that are not finite as 0.

    A pixel counts in the two nearest cells of each axis, more in the nearer, so the middle of a source's light stays
    where it is, and its halo moves as evenly as the source. Columns are summed first, into `sums`, (width,): such a
    loop becomes vectors, and has one order on every machine.
    """
    (height, width), (rows, columns) = values.shape, means.shape
    for i in range(rows):
        top, bottom = _reach(i, height, rows)
        for x in range(width):
            sums[x] = 0.0
        weight = 0.0
        for y in range(top, bottom):
            row, part = values[y], 1 - abs(_place(y, height, rows) - i)
            weight += part
            for x in range(width):
                e = row[x]
                sums[x] += part * ((e if e > least else least) if abs(e) <= _LARGEST else np.float32(0))
        for j in range(columns):
            left, right = _reach(j, width, columns)
            total = across = 0.0
            for x in range(left, right):
                part = 1 - abs(_place(x, width, columns) - j)
                across += part
                total += part * sums[x]
            means[i, j] = total / (weight * across)


@_entry
def _add_scattered(
    values: Light, share: np.float32, scattered: Floats, places: Light, between: Light, out: Light
) -> None:
    """Write share * values + the scattered light to `out`; `between`, (columns of cells,), is overwritten.

    It is linear from middle to middle of cells: loops that become vectors, as `places`, 0 to width - 1, are float32.
    """
    (height, width), (rows, columns) = values.shape, scattered.shape
    for y in range(height):
        down = _place(y, height, rows)
        upper = min(int(down), max(rows - 2, 0))
        lower, part = min(upper + 1, rows - 1), down - upper
        for j in range(columns):
            between[j] = scattered[upper, j] + part * (scattered[lower, j] - scattered[upper, j])
        begin = 0
        for j in range(-1, columns):
            left, right = between[max(j, 0)], between[min(j + 1, columns - 1)]
            middle = np.float32((j + 0.5) * width / columns - 0.5)
            end = width if j == columns - 1 else int(np.ceil((j + 1.5) * width / columns - 0.5))
            slope = (right - left) * np.float32(columns / width)
            source, target = values[y, begin:end], out[y, begin:end]
            place = places[begin:end]
            for x in range(target.size):
                target[x] = source[x] * share + (left + slope * (place[x] - middle))
            begin = end


def _transfer(lens: LensParameters, size: tuple[int, int], cells: tuple[int, int]) -> Floats:
    """Return the share of each wave of the image that is scattered, (rows, columns) of a cosine transform."""
    squares_px2 = []
    for pixels, n in zip(size[::-1], cells, strict=True):  # of distances from a cell, at most half of the way around
        apart = np.add.outer(np.arange(n + 1), (np.arange(_WITHIN) + 0.5) / _WITHIN - 0.5).ravel()
        squares_px2.append((np.minimum(apart, 2 * n - apart) * pixels / n) ** 2)
    law = (1 + np.add.outer(*squares_px2) / lens.halo_px**2) ** (-lens.halo_power / 2)
    halo = law.reshape(cells[0] + 1, _WITHIN, cells[1] + 1, _WITHIN).mean(axis=(1, 3))
    halo = np.pad(halo, [(0, n - 1) for n in cells], mode="reflect")  # of the image and its mirror image
    scattered = lens.halo * np.fft.rfft2(halo / halo.sum()).real[: cells[0], : cells[1]]
    scattered[0, 0] += lens.veiling_glare
    return np.asarray(scattered)


class Veiled(OtherLight):
    """A scene with the scattered light of a lens.

    `scene` is in light on the pixels, and closed with this one; of `lens` only the shares and the shape of scattered
    light count.
    """

    def __init__(self, scene: Scene, lens: LensParameters) -> None:
        from scipy.fft import next_fast_len  # loaded where it is used: few lenses scatter

        super().__init__(scene)
        self._share = np.float32(1 - lens.veiling_glare - lens.halo)
        width, height = scene.size
        self._inner = np.zeros((height, width), np.float32), np.zeros((height, width), np.float32)
        cells = (next_fast_len(-(-height // _CELL_PX)), next_fast_len(-(-width // _CELL_PX))) if lens.halo else (1, 1)
        self._transfer = _transfer(lens, scene.size, cells)
        self._sums, self._row = np.zeros(width), np.zeros(cells[1], np.float32)
        self._places = np.arange(width, dtype=np.float32)
        self._arrays = LastArrays()

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns` into `out`."""
        self.scene.light(t_ns, self._inner[0])
        self._veil(t_ns, (out,))

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write the light at `t_ns` and its time derivative."""
        self.scene.light_and_rate(t_ns, *self._inner)
        self._veil(t_ns, (light, rate))

    def _veil(self, t_ns: int, outs: tuple[Light, ...]) -> None:
        """Write the light of the scene, with what is scattered, to `outs`; nothing where they have it already."""
        changed = self.scene.changed
        still = self._arrays.are(*outs) and changed is not None and changed.empty
        self.changed = changed if still else None
        if still:
            return
        for values, least, out in zip(self._inner, (np.float32(0), -_LARGEST), outs, strict=False):
            _add_scattered(values, self._share, self._spread(values, least), self._places, self._row, out)

    def _spread(self, values: Light, least: np.float32) -> Floats:
        """Return the scattered part of an image at the middles of cells."""
        from scipy.fft import dctn, idctn

        means = np.empty_like(self._transfer)
        _cell_means(values, least, self._sums, means)
        return np.ascontiguousarray(idctn(dctn(means) * self._transfer))
