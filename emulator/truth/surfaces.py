"""Which surface each pixel's middle shows, and how near it is.

The nearest facet at a middle is that of the renderer of light (`raster`), found by depth alone. 1 / depth is linear
over a facet on the picture, so the facet's plane tells it exactly. Where a lens bends lines, the facet is the one at
the nearest pixel of the straight picture, and its plane is taken at the ray itself: beside an outline the label may be
wrong by half a pixel.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from emulator.geometry.pinhole import Pinhole
from emulator.geometry.seen import Rays
from emulator.raster import Renderer, Screen, View, join, prepare
from emulator.raster.layout import W, WHighest, WLowest
from emulator.truth.compiled import entry

__all__ = ["NearestSurface", "Surface", "nearest_along"]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]

Surface = tuple[Ints, int, bool]
"""Facets, (m, 3); number of vertices; whether it is seen from behind too."""


class NearestSurface:
    """The surfaces of several bodies before one camera; label k is surface k - 1.

    Parameters
    ----------
    nearest_m : facets are cut at this depth.
    """

    def __init__(self, surfaces: Sequence[Surface], camera: Pinhole, nearest_m: float) -> None:
        width, height = camera.size
        self._camera = camera
        topology = join([prepare(faces, two_sided=two_sided) for faces, _, two_sided in surfaces])
        screen = Screen(width, height, camera.focal_px, (width / 2, height / 2), nearest_m)
        self._renderer = Renderer(topology, screen)
        self._last = np.cumsum([count for _, count, _ in surfaces])
        self._nearest = np.full((height, width), -1, np.int32)
        self._dark = np.zeros(topology.entries)

    def look(self, vertices: Floats, rays: Rays, labels: npt.NDArray[np.uint16], inverse_depth: Floats) -> None:
        """Write labels and 1 / depth along `rays`; `vertices`, (n, 3) m, are all surfaces' in the camera's axes."""
        view = View(vertices, np.zeros_like(vertices), self._dark, self._dark)
        self._renderer.nearest(view, self._nearest)
        of_vertex = np.searchsorted(self._last, self._renderer.corners(), side="right") + 1
        nearest_along(self._nearest, self._renderer.facets, of_vertex.astype(np.uint16), rays, (labels, inverse_depth))

    def close(self) -> None:
        """Give back what the renderer holds."""
        self._renderer.close()


def nearest_along(
    nearest: Ints,
    facets: Floats,
    label: npt.NDArray[np.uint16],
    rays: Rays,
    out: tuple[npt.NDArray[np.uint16], Floats],
) -> None:
    """Write labels and 1 / depth along `rays`.

    Parameters
    ----------
    nearest : (rows, columns), the facet at each pixel of the straight picture; -1 for none.
    facets : of `Renderer.facets`.
    label : (m,), of each facet.
    """
    _along(nearest, facets, label, rays.columns, rays.rows, *out)


@entry
def _along(
    nearest: Ints,
    facets: Floats,
    label: npt.NDArray[np.uint16],
    columns: Floats,
    rows: Floats,
    labels: npt.NDArray[np.uint16],
    inverse_depth: Floats,
) -> None:
    for r in range(labels.shape[0]):
        for c in range(labels.shape[1]):
            x, y = columns[r, c], rows[r, c]
            i, j = min(max(int(y), 0), nearest.shape[0] - 1), min(max(int(x), 0), nearest.shape[1] - 1)
            f = nearest[i, j]
            if f < 0:
                labels[r, c], inverse_depth[r, c] = 0, 0.0
            else:
                w = facets[f, W] + facets[f, W + 1] * x + facets[f, W + 2] * y
                labels[r, c], inverse_depth[r, c] = label[f], min(max(w, facets[f, WLowest]), facets[f, WHighest])
