"""Light frames of surfaces: exact mean radiance of every pixel and its exact time derivative, by the CPU."""

from __future__ import annotations

from typing import Any

import numpy as np

from emulator.light import NOTHING, Region
from emulator.raster.bands import draw_bands, nearest_facets
from emulator.raster.layout import BAND, FACET_FIELDS, VERTEX_FIELDS, Data, Lists, Owners, Scratch, Screen, View
from emulator.raster.lines import LINE_FIELDS, SIDE_FIELDS
from emulator.raster.projection import bucket, clip, project, set_up
from emulator.raster.topology import Topology
from emulator.threads import ThreadPool
from firmware_protocol.events import Float32s, Int32s

_FIRST_PAIRS = 1 << 14
_SPARE = 8  # a share of all rows: the parts of facets become a few more in each light frame of a body that comes nearer
_RUNS_A_THREAD = 4  # of bands: with 6 a light frame took 3 % more processor time

_NO_OWNERS = Owners.of(0, 0)


def _new_scratch(screen: Screen) -> Scratch:
    width, pixels = screen.width, BAND * screen.width
    return Scratch(
        acc=np.zeros((BAND, width + 1, 8)),
        depth=np.zeros((BAND + 2, width + 2)),
        nearest=np.full((BAND + 2, width + 2), -1, np.int32),
        held=np.zeros(0, np.int32),
        shows=np.zeros(0, np.int32),
        slots=np.full((BAND, width), -1, np.int32),
        places=np.zeros((pixels, 2), np.int32),
        masks=np.zeros(width, np.int32),
        answers=np.zeros((pixels, 2)),
        ends=np.zeros(pixels, np.int32),
        **_room_for(_FIRST_PAIRS),
    )


def _room_for(pairs: int) -> dict[str, Any]:
    """Return the arrays of a `Scratch` for `pairs` pairs of a pixel and a facet in a band."""
    return {
        "pairs": np.zeros((pairs, 2), np.int32),
        "grouped": np.zeros(pairs, np.int32),
        "keys": np.zeros(pairs),
        "sides": np.zeros((pairs, SIDE_FIELDS)),
        "lines": np.zeros((pairs, LINE_FIELDS)),
    }


class Renderer:
    """Draws surfaces of one topology on one screen; its methods are not for use by several threads at a time.

    `topology` has the facets of all surfaces, see `prepare` and `join`. `threads` draw bands of rows; the light frames
    are the same to the last bit with any number of them.
    """

    def __init__(self, topology: Topology, screen: Screen, threads: int = 1) -> None:
        self.topology, self.screen = topology, screen
        self._starts = np.zeros(-(-screen.height // BAND) + 2, np.int32)
        self._listed = np.zeros(0, np.int32)
        self._touched = np.zeros(4, np.int32)
        self._vertices, self._kinds = np.zeros((0, VERTEX_FIELDS)), np.zeros(0, np.uint8)
        self.facets, self._spans = np.zeros((0, FACET_FIELDS)), np.zeros((0, 2), np.int32)
        self._scratches = [_new_scratch(screen) for _ in range(threads)]
        self._take(topology)
        self._pool = ThreadPool(threads)

    def draw(
        self, view: View, light: Float32s, rate: Float32s, before: Region | None = None, owners: Owners = _NO_OWNERS
    ) -> Region:
        """Write mean radiance and its rate, a second, (height, width) float32; return the part that surfaces touch.

        Only this part and `before` are written: the part of the two arrays with light of an earlier frame, an empty
        one for arrays of zeros, None for unknown content. The same part of `owners` is written.
        """
        self._prepare(view)
        row0, row1, column0, column1 = (int(k) for k in self._touched)
        touched = Region(row0, row1, column0, column1) if row0 < row1 else NOTHING
        frame = Region(0, self.screen.height, 0, self.screen.width)
        window = touched.union(frame if before is None else before)
        if not window.empty:
            self._draw(window, light, rate, owners)
        return touched

    def nearest(self, view: View, out: Int32s) -> None:
        """Write the row of `facets` that is the nearest at each pixel's middle, (height, width) int32; -1 for none."""
        self._prepare(view)
        scratch = self._scratches[0]
        nearest_facets(self.data, self._lists, scratch.depth, scratch.nearest, scratch.held, out)

    def corners(self) -> Int32s:
        """Return a vertex of each of `facets`, (m,): its first that was not made by a cut at the nearest depth."""
        return np.ascontiguousarray(self._drawn.faces[:, 0])

    def close(self) -> None:
        """End the threads; a second call does nothing."""
        self._pool.close()

    def _draw(self, window: Region, light: Float32s, rate: Float32s, owners: Owners) -> None:
        """Draw the bands of a window: threads take a few in turn, so that one on a busy core does not hold up all."""
        first, last = window.first_row // BAND, -(-window.last_row // BAND)
        threads = len(self._scratches)
        run = last - first if threads == 1 else -(-(last - first) // (_RUNS_A_THREAD * threads))
        for scratch in self._scratches:
            scratch.shows.fill(-1)
            scratch.held.fill(-1)

        def draw(share: int, thread: int) -> None:
            band = first + share * run
            end = min(band + run, last)
            while band >= 0:
                scratch, columns = self._scratches[thread], (window.first_column, window.last_column)
                band, pairs = draw_bands(self.data, (band, end), self._lists, columns, scratch, owners, light, rate)
                if band >= 0:
                    self._scratches[thread] = scratch._replace(**_room_for(2 * pairs))

        self._pool.each(draw, -(-(last - first) // run))

    @property
    def shades(self) -> Int32s:
        """Entries of the radiance at the corners of `facets`, (m, 3)."""
        return self._drawn.shades

    @property
    def data(self) -> Data:
        """All that was drawn last."""
        t = self._drawn
        return Data(self._vertices, t.faces, t.across, t.smooth, self.facets, self._kinds, t.over)

    @property
    def _lists(self) -> Lists:
        return Lists(self._starts, self._listed)

    def _take(self, topology: Topology) -> None:
        """Select the topology to draw, with room for its vertices and facets."""
        self._drawn, facets = topology, len(topology.faces)
        if topology.vertices > len(self._vertices):
            self._vertices = np.zeros((topology.vertices + topology.vertices // _SPARE, VERTEX_FIELDS))
        if facets > len(self._kinds):
            rows = facets + facets // _SPARE
            self.facets, self._kinds = np.zeros((rows, FACET_FIELDS)), np.zeros(rows, np.uint8)
            self._spans = np.zeros((rows, 2), np.int32)
            for k, scratch in enumerate(self._scratches):
                self._scratches[k] = scratch._replace(held=np.zeros(rows, np.int32), shows=np.zeros(rows, np.int32))

    def _prepare(self, view: View) -> None:
        """Project, cut and sort into bands."""
        t, screen = self.topology, self.screen
        if len(view.positions_m) < t.vertices or len(view.radiance) < t.entries:
            raise ValueError(
                f"the view has {len(view.positions_m)} vertices and {len(view.radiance)} radiances, "
                f"its facets need {t.vertices} and {t.entries}"
            )
        if self._project(t, view):
            t, view = clip(t, view, screen.nearest_m)
            self._project(t, view)
        entries = set_up(
            self._vertices, t.faces, t.shades, t.two_sided, t.over, view.radiance, view.radiance_rate,
            (screen.height, screen.width), self.facets, self._kinds, self._spans, self._touched
        )  # fmt: skip
        if entries > len(self._listed):
            self._listed = np.zeros(2 * entries, np.int32)
        bucket(self._spans[: len(t.faces)], self._starts, self._listed)

    def _project(self, topology: Topology, view: View) -> bool:
        """Project the vertices; return whether any is too near or behind."""
        self._take(topology)
        screen, n = self.screen, topology.vertices
        camera = np.array([screen.focal_px, *screen.centre_px, screen.nearest_m])
        return bool(project(view.positions_m[:n], view.velocities_m_s[:n], camera, self._vertices))
