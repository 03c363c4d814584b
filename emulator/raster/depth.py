"""The nearest facet at samples, and the selection of facets that may show.

Samples are the middles of a band's pixels and of one more pixel all around.
"""

from __future__ import annotations

import math

from emulator.raster.compiled import entry, kernel, lane
from emulator.raster.layout import (
    BAND,
    Band,
    Data,
    Floats,
    Ints,
    Lists,
    W,
    WHighest,
    WLowest,
    XHigh,
    XLow,
    YHigh,
    YLow,
)

_ON_A_SIDE = 1e-9  # pixels: a middle so near a facet's side lies on it


@lane
def fill_depth(data: Data, listed: Ints, depth: Floats, nearest: Ints, held: Ints, band: Band) -> None:
    """Write the largest 1 / depth and its facet at the samples of a band.

    Facets that hold a sample, not on a side alone, get the number of the band in `held`.
    """
    vertices, faces, facets = data.vertices, data.faces, data.facets
    width = depth.shape[1] - 2
    for f in listed:
        # Rows whose middles the facet's box holds; most facets of a fine mesh hold none and are left here.
        r0 = math.ceil(max(facets[f, YLow], band.first_row - 1.0) - 0.5)
        r1 = math.floor(min(facets[f, YHigh], band.end_row + 1.0) - 0.5)
        if r1 < r0 or math.floor(facets[f, XHigh] - 0.5) < math.ceil(facets[f, XLow] - 0.5):
            continue
        # Corners by ascending y: the side a-c is on one side of the facet, a-b and b-c are on the other one.
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if vertices[a, 1] > vertices[b, 1]:
            a, b = b, a
        if vertices[b, 1] > vertices[c, 1]:
            b, c = c, b
        if vertices[a, 1] > vertices[b, 1]:
            a, b = b, a
        ax, ay = vertices[a, 0], vertices[a, 1]
        bx, by = vertices[b, 0], vertices[b, 1]
        cx, cy = vertices[c, 0], vertices[c, 1]
        # Growth of x a row on each side.
        long = (cx - ax) / (cy - ay)
        upper = (bx - ax) / (by - ay) if by > ay else 0.0
        lower = (cx - bx) / (cy - by) if cy > by else 0.0
        wx, low, high = facets[f, W + 1], facets[f, WLowest], facets[f, WHighest]
        low_y, high_y = ay + _ON_A_SIDE, cy - _ON_A_SIDE
        holds = False
        for r in range(r0, r1 + 1):
            y = r + 0.5
            left = ax + (y - ay) * long
            right = ax + (y - ay) * upper if y < by else bx + (y - by) * lower
            if left > right:
                left, right = right, left
            c0 = math.ceil(max(left, -1.0) - 0.5)
            c1 = math.floor(min(right, width + 1.0) - 0.5)
            if c0 > c1:
                continue
            # A middle exactly on a side may belong to the neighbour: it does not show that the facet is hidden.
            within = math.ceil(left - 0.5 + _ON_A_SIDE) <= math.floor(right - 0.5 - _ON_A_SIDE)
            holds = holds or (within and low_y < y < high_y)
            # The plane of 1 / depth, kept within the corners' range: thin facets have steep planes.
            at_row = facets[f, W] + facets[f, W + 2] * y
            line, owner = depth[r - band.first_row + 1], nearest[r - band.first_row + 1]
            for column in range(c0, c1 + 1):
                w = min(max(at_row + wx * (column + 0.5), low), high)
                if w > line[column + 1]:
                    line[column + 1], owner[column + 1] = w, f
        if holds:
            held[f] = band.number


@kernel
def mark_seen(nearest: Ints, columns: tuple[int, int], shows: Ints, band: int) -> None:
    """Mark the facets that are the nearest at a sample."""
    for r in range(nearest.shape[0]):
        for c in range(columns[0], columns[1]):
            f = nearest[r, c]
            if f >= 0:
                shows[f] = band


@lane
def may_show(facets: Floats, f: int, depth: Floats, band: Band) -> bool:
    """Return whether a sample in the facet's box, one pixel wider, is not nearer than the facet."""
    if facets[f, YHigh] <= band.first_row or facets[f, YLow] >= band.end_row:
        return False
    width = depth.shape[1] - 2
    if facets[f, XLow] >= width:
        return False
    closest = facets[f, WHighest] * (1.0 + 1e-12)
    r0 = int(max(facets[f, YLow], band.first_row)) - 1
    r1 = int(min(facets[f, YHigh], band.end_row - 1.0)) + 1
    c0 = int(max(facets[f, XLow], 0.0)) - 1
    c1 = int(min(max(facets[f, XHigh], 0.0), width - 1.0)) + 1
    # Samples begin a row above the band and a column left of the frame.
    for r in range(r0 - band.first_row + 1, r1 - band.first_row + 2):
        for c in range(c0 + 1, c1 + 2):
            if depth[r, c] <= closest:
                return True
    return False


@lane
def alone(nearest: Ints, r: int, c: int) -> int:
    """Return the facet that is the nearest at all samples around a pixel, -1 for none: it contains the pixel."""
    f: int = nearest[r + 1, c + 1]
    for i in range(r, r + 3):
        for j in range(c, c + 3):
            if nearest[i, j] != f:
                f = -1
    return f


@entry
def nearest_facets(data: Data, lists: Lists, depth: Floats, nearest: Ints, held: Ints, out: Ints) -> None:
    """Write the facet that is the nearest at each pixel's middle, (height, width); -1 for none.

    Parameters
    ----------
    depth, nearest, held : of `Scratch`.
    """
    height, width = out.shape
    for number in range(-(-height // BAND)):
        band = Band(number, number * BAND, min((number + 1) * BAND, height))
        depth[:] = 0.0
        nearest[:] = -1
        fill_depth(data, lists.listed[lists.starts[number] : lists.starts[number + 1]], depth, nearest, held, band)
        for r in range(band.first_row, band.end_row):
            out[r] = nearest[r - band.first_row + 1, 1 : width + 1]
