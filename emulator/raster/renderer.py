"""Pictures of surfaces: exact mean radiance of every pixel and its exact time derivative, by the CPU."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from emulator.raster.bands import draw_bands
from emulator.raster.layout import BAND, FACET_FIELDS, VERTEX_FIELDS, Floats, Ints, Pictures
from emulator.raster.lines import LINE_FIELDS
from emulator.raster.projection import bucket, project, set_up
from emulator.raster.topology import Topology
from emulator.raster.view import Box, Screen, View

__all__ = ["Renderer"]

_FIRST_PAIRS = 1 << 14


class _Scratch:
    """Memory of one thread, for one band at a time."""

    def __init__(self, screen: Screen, facets: int) -> None:
        width = screen.width
        self.acc = np.zeros((BAND, width + 1, 8))
        self.depth = np.zeros((BAND + 2, width + 2))
        self.nearest = np.full((BAND + 2, width + 2), -1, np.int32)
        self.held = np.full(facets, -1, np.int32)
        self.shows = np.full(facets, -1, np.int32)
        self.slots = np.full((BAND, width), -1, np.int32)
        self.found = np.zeros((BAND * width, 2), np.int32)
        self.masks = np.zeros(width, np.int32)
        self.ends = np.zeros(BAND * width, np.int32)
        self.grow(_FIRST_PAIRS)

    def grow(self, pairs: int) -> None:
        """Make room for that many pairs of a pixel and a facet in a band."""
        self.pairs = np.zeros((pairs, 2), np.int32)
        self.grouped = np.zeros(pairs, np.int32)
        self.keys = np.zeros(pairs)
        self.lines = np.zeros((pairs, LINE_FIELDS))

    @property
    def arrays(self) -> tuple[npt.NDArray[np.generic], ...]:
        """As `draw_bands` wants them."""
        return (
            self.acc,
            self.depth,
            self.nearest,
            self.held,
            self.shows,
            self.slots,
            self.found,
            self.masks,
            self.ends,
            self.pairs,
            self.grouped,
            self.keys,
            self.lines,
        )


class Renderer:
    """Draws surfaces of one topology on one screen; not for use by several threads at a time.

    Parameters
    ----------
    topology : facets of all surfaces, see `prepare` and `join`.
    """

    def __init__(self, topology: Topology, screen: Screen) -> None:
        self.topology, self.screen = topology, screen
        self._bands = -(-screen.height // BAND)
        facets = len(topology.faces)
        self._vertices = np.zeros((topology.vertices, VERTEX_FIELDS))
        self._facets = np.zeros((facets, FACET_FIELDS))
        self._kinds = np.zeros(facets, np.uint8)
        self._touched = np.zeros(4, np.int32)
        self._starts = np.zeros(self._bands + 2, np.int32)
        self._listed = np.zeros(0, np.int32)
        self._scratch = _Scratch(screen, facets)

    def draw(self, view: View, light: Pictures, rate: Pictures, before: Box | None = None) -> Box:
        """Write mean radiance and its rate, a second, (height, width) float32; return the part that surfaces touch.

        Only this part and `before` are written: the part that the two arrays hold already of an earlier picture, an
        empty box for arrays of zeros, None for unknown content.
        """
        self._prepare(view)
        row0, row1, column0, column1 = (int(k) for k in self._touched)
        touched = Box(row0, row1, column0, column1) if row0 < row1 else Box()
        whole = Box(0, self.screen.height, 0, self.screen.width)
        window = touched.union(whole if before is None else before)
        if not window.empty:
            self._draw(window, light, rate)
        return touched

    def _draw(self, window: Box, light: Pictures, rate: Pictures) -> None:
        band, last = window.first_row // BAND, -(-window.last_row // BAND)
        columns = window.first_column, window.last_column
        self._scratch.shows.fill(-1)
        self._scratch.held.fill(-1)
        while band >= 0:
            band, pairs = draw_bands(
                self._data, (band, last, 1), (self._starts, self._listed), columns, self._scratch.arrays, light, rate
            )
            if band >= 0:
                self._scratch.grow(2 * pairs)

    @property
    def _data(self) -> tuple[Floats, Ints, Ints, npt.NDArray[np.uint8], Floats, npt.NDArray[np.uint8]]:
        t = self.topology
        return self._vertices, t.faces, t.across, t.smooth, self._facets, self._kinds

    def _prepare(self, view: View) -> None:
        """Project and sort into bands."""
        t, screen = self.topology, self.screen
        if len(view.positions_m) < t.vertices or len(view.radiance) < t.entries:
            raise ValueError(
                f"the view has {len(view.positions_m)} vertices and {len(view.radiance)} radiances, "
                f"its facets name {t.vertices} and {t.entries}"
            )
        camera = np.array([screen.focal_px, *screen.centre_px, screen.nearest_m])
        project(view.positions_m[: t.vertices], view.velocities_m_s[: t.vertices], camera, self._vertices)
        entries = set_up(
            self._vertices,
            t.faces,
            t.shades,
            t.two_sided,
            view.radiance,
            view.radiance_rate,
            (screen.height, screen.width),
            self._facets,
            self._kinds,
            self._touched,
        )
        if entries > len(self._listed):
            self._listed = np.zeros(2 * entries, np.int32)
        bucket(self._kinds, self._facets, screen.height, self._starts, self._listed)
