"""The nearest facet at the middle of each pixel alone, without any light."""

from __future__ import annotations

from emulator.raster.compiled import entry
from emulator.raster.depth import fill_depth
from emulator.raster.layout import BAND, Data, Floats, Ints

__all__ = ["nearest_facets"]


@entry
def nearest_facets(data: Data, lists: Data, scratch: tuple[Floats, Ints, Ints], out: Ints) -> None:
    """Write the facet that is the nearest at each pixel's middle, (height, width); -1 for none.

    Parameters
    ----------
    data : vertices, faces, across, smooth, facets, kinds, over.
    lists : `starts` and `listed` of `projection.bucket`.
    scratch : depth and nearest of one band, and a number for each facet.
    """
    starts, listed = lists
    depth, nearest, held = scratch
    height, width = out.shape
    for band in range(-(-height // BAND)):
        here = listed[starts[band] : starts[band + 1]]
        first, last = band * BAND, min((band + 1) * BAND, height)
        depth[:] = 0.0
        nearest[:] = -1
        fill_depth(data, here, depth, nearest, held, (first, last, band))
        for r in range(first, last):
            out[r] = nearest[r - first + 1, 1 : width + 1]
