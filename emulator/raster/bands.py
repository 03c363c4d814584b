"""Drawing of a light frame in bands of rows, each in one pass.

1. Depth: the nearest 1 / depth at samples, the middles of a band's pixels and of one more pixel all around.
2. A facet shows if it is the nearest at a sample, or if it covers no sample and any sample in its box, one pixel
   wider, is not nearer than its nearest point. This excludes hidden facets from the sums; where it errs, areas do
   not add up to one.
3. The edges of facets that show go into sums along rows (`rows`): of a patch no area, and the difference of its light.
4. A pixel with the area 1 has its light. One with several whole layers, of which the same facet is the nearest at all
   samples around, has the light of this facet. All other touched pixels are computed one by one from all facets
   that touch them, hidden ones too (`pixel`).

Two measures make it fast: a band's arrays stay in the second-level cache; only columns that facets touch are cleared
and read.
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emulator.raster.layout import (
    BAND,
    Band,
    Data,
    G,
    L,
    Lists,
    Owners,
    Scratch,
    W,
    WHighest,
    WLowest,
    XHigh,
    XLow,
    YHigh,
    YLow,
    entry,
)
from emulator.raster.pixel import TOLERANCE, pixel_light
from emulator.raster.rows import add_facet
from emulator.sensor.numerics.compiled import kernel, lane
from firmware_protocol.events import Float32s, Floats, Int32s

_ON_A_SIDE = 1e-9  # pixels: a middle so near a facet's side lies on it


@lane
def fill_depth(data: Data, listed: Int32s, depth: Floats, nearest: Int32s, held: Int32s, band: Band) -> None:
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
def mark_seen(nearest: Int32s, columns: tuple[int, int], shows: Int32s, band: int) -> None:
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
def alone(nearest: Int32s, r: int, c: int) -> int:
    """Return the facet that is the nearest at all samples around a pixel, -1 for none: it contains the pixel."""
    f: int = nearest[r + 1, c + 1]
    for i in range(r, r + 3):
        for j in range(c, c + 3):
            if nearest[i, j] != f:
                f = -1
    return f


@entry
def nearest_facets(data: Data, lists: Lists, depth: Floats, nearest: Int32s, held: Int32s, out: Int32s) -> None:
    """Write the facet that is the nearest at each pixel's middle, (height, width); -1 for none.

    `depth`, `nearest` and `held` are those of `Scratch`.
    """
    height, width = out.shape
    for number in range(-(-height // BAND)):
        band = Band(number, number * BAND, min((number + 1) * BAND, height))
        depth[:] = 0.0
        nearest[:] = -1
        fill_depth(data, lists.listed[lists.starts[number] : lists.starts[number + 1]], depth, nearest, held, band)
        for r in range(band.first_row, band.end_row):
            out[r] = nearest[r - band.first_row + 1, 1 : width + 1]


_EMPTY = 1e-9  # of a pixel: less is rounding of sums along a row


class Columns(NamedTuple):
    """Columns of a band that facets touch, and around them those that are written; the ends are not included."""

    first: int
    end: int
    window_first: int
    window_end: int


@lane
def _extent(facets: Floats, listed: Int32s, width: int) -> tuple[int, int]:
    """Return the first column that facets touch and the one after the last."""
    low, high = width, 0
    for f in listed:
        low = min(low, int(min(max(facets[f, XLow], 0.0), width - 1.0)))
        high = max(high, int(min(max(facets[f, XHigh], 0.0), width - 1.0)) + 1)
    return low, high


@lane
def _sum_up(
    band: Band, columns: Columns, facets: Floats, scratch: Scratch, owners: Owners, light: Float32s, rate: Float32s
) -> int:
    """Write pixels whose area is a whole number; list the others, number them in `slots`; return their number."""
    acc, nearest = scratch.acc, scratch.nearest
    slots, places, masks = scratch.slots, scratch.places, scratch.masks
    has_owners = len(owners.facets) > 0
    n = 0
    for r in range(band.end_row - band.first_row):
        row = band.first_row + r
        # No facet touches the window beyond `columns`: it is black there.
        for c in range(columns.window_first, columns.first):
            light[row, c] = rate[row, c] = 0.0
        for c in range(columns.end, columns.window_end):
            light[row, c] = rate[row, c] = 0.0
        if has_owners:
            owners.facets[row, columns.window_first : columns.window_end] = -1
            owners.coverage[row, columns.window_first : columns.window_end] = 1.0
            for c in range(columns.first, columns.end):
                owners.facets[row, c] = nearest[r + 1, c + 1]
        # Sums along the row, see `rows`: what edges further left add to each pixel right of them, before what an edge
        # within the pixel adds to it. The planes' growth down the row is part of them; that to the right is not.
        cell = acc[r, columns.first]
        area = cell[1]
        light_sum, light_right = cell[3], cell[4]
        rate_sum, rate_right = cell[6], cell[7]
        for c in range(columns.first, columns.end):
            cell = acc[r, c + 1]
            covered = area + cell[0]
            value = cell[2] + light_sum + light_right * (c + 0.5)
            changing = cell[5] + rate_sum + rate_right * (c + 0.5)
            area += cell[1]
            light_sum += cell[3]
            light_right += cell[4]
            rate_sum += cell[6]
            rate_right += cell[7]
            if abs(covered) <= _EMPTY:
                value, changing = 0.0, cell[5]  # an edge that enters just now
            elif abs(covered - 1.0) > TOLERANCE:
                # Other layers, or an outline. Where one facet hides whole layers around, the pixel has its light.
                f = alone(nearest, r, c)
                if f >= 0 and abs(covered - round(covered)) <= TOLERANCE:
                    x, y = c + 0.5, row + 0.5
                    value = facets[f, L] + facets[f, L + 1] * x + facets[f, L + 2] * y
                    changing = facets[f, G] + facets[f, G + 1] * x + facets[f, G + 2] * y
                else:
                    slots[r, c] = n
                    masks[c] |= 1 << r
                    places[n, 0], places[n, 1] = row, c
                    n += 1
                    if has_owners:
                        owners.coverage[row, c] = abs(2.0 * (covered - math.floor(covered)) - 1.0)
            light[row, c] = max(value, 0.0)
            rate[row, c] = changing
    return n


@lane
def _pair_up(data: Data, listed: Int32s, band: Band, columns: tuple[int, int], scratch: Scratch) -> int:
    """Write (slot, facet) of each listed pixel that a facet touches; return their number, beyond the room too.

    Few pixels are listed, and most facets touch none of them. The facet's box is narrowed to columns, then in each row
    to places, with a listed pixel; only there the facet itself is looked at.
    """
    vertices, faces, facets = data.vertices, data.faces, data.facets
    slots, masks, pairs = scratch.slots, scratch.masks, scratch.pairs
    n = 0
    for f in listed:
        if facets[f, XHigh] < columns[0] or facets[f, XLow] >= columns[1] or facets[f, YHigh] < band.first_row:
            continue
        r0 = int(max(facets[f, YLow], band.first_row))
        r1 = int(min(facets[f, YHigh], band.end_row - 1.0))
        b0 = int(max(facets[f, XLow], columns[0]))
        b1 = int(min(facets[f, XHigh], columns[1] - 1.0))
        rows = ((2 << (r1 - band.first_row)) - 1) & ~((1 << (r0 - band.first_row)) - 1)  # bits r0 to r1
        while b0 <= b1 and masks[b0] & rows == 0:
            b0 += 1
        while b1 >= b0 and masks[b1] & rows == 0:
            b1 -= 1
        if b0 > b1:
            continue
        for r in range(r0, r1 + 1):
            line = slots[r - band.first_row]
            c0, c1 = b0, b1
            while c0 <= c1 and line[c0] < 0:
                c0 += 1
            while c1 >= c0 and line[c1] < 0:
                c1 -= 1
            if c0 > c1:
                continue
            left, right = _strip(vertices, faces, f, r)
            for c in range(c0, c1 + 1):
                if line[c] >= 0 and left <= c + 1.0 and right >= c:
                    if n < len(pairs):
                        pairs[n, 0], pairs[n, 1] = line[c], f
                    n += 1
    return n


@lane
def _strip(vertices: Floats, faces: Int32s, f: int, row: int) -> tuple[float, float]:
    """Return the least and the largest column of a facet within a row."""
    left, right = 1e300, -1e300
    low, high = float(row), row + 1.0
    # They are at a corner within the row, or where a side crosses one of the row's borders.
    for side in range(3):
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay = vertices[a, 0], vertices[a, 1]
        bx, by = vertices[b, 0], vertices[b, 1]
        if low <= ay <= high:
            left, right = min(left, ax), max(right, ax)
        for y in (low, high):
            if (ay < y) != (by < y):
                x = ax + (y - ay) / (by - ay) * (bx - ax)
                left, right = min(left, x), max(right, x)
    return left, right


@lane
def _group(pairs: Int32s, n: int, ends: Int32s, grouped: Int32s) -> None:
    """Sort facets by slot, keeping their order: those of slot k end at ends[k]."""
    ends[:] = 0
    for i in range(n):
        ends[pairs[i, 0]] += 1
    # Counts become beginnings, and these, one facet after another, ends.
    total = 0
    for k in range(len(ends)):
        count = ends[k]
        ends[k] = total
        total += count
    for i in range(n):
        k = pairs[i, 0]
        grouped[ends[k]] = pairs[i, 1]
        ends[k] += 1


@kernel
def _one_by_one(data: Data, listed: Int32s, n: int, band: Band, columns: tuple[int, int], scratch: Scratch) -> int:
    """Write light and rate of the first n of `places` to `answers`; return 0, or the pairs that lack room.

    The pixels' numbers and bits are taken back, so that the next band finds none.
    """
    slots, places, ends, grouped = scratch.slots, scratch.places, scratch.ends, scratch.grouped
    count: int = _pair_up(data, listed, band, columns, scratch)
    scratch.masks[columns[0] : columns[1]] = 0
    for k in range(n):
        slots[places[k, 0] - band.first_row, places[k, 1]] = -1
    if count > len(scratch.pairs):
        return count
    _group(scratch.pairs, count, ends[:n], grouped)
    begin = 0
    for k in range(n):
        value, changing = pixel_light(data, places[k, 1], places[k, 0], grouped[begin : ends[k]], scratch)
        scratch.answers[k, 0], scratch.answers[k, 1] = max(value, 0.0), changing
        begin = ends[k]
    return 0


@lane
def _mark_hidden_samples(data: Data, listed: Int32s, band: Band, scratch: Scratch) -> None:
    """Mark the facets that may show although they are the nearest at no sample; patches show where their facets do.

    A patch has no area, so the sum of areas would not show that one is missing.
    """
    over, shows, held = data.over, scratch.shows, scratch.held
    for f in listed:
        if over[f] >= 0 and shows[f] == band.number:
            shows[over[f]] = band.number
    for f in listed:
        # A facet that holds a sample and is the nearest at none is hidden there, and taken to be hidden altogether.
        is_open = over[f] < 0 and shows[f] != band.number and held[f] != band.number
        if is_open and may_show(data.facets, f, scratch.depth, band):
            shows[f] = band.number
    for f in listed:
        if over[f] >= 0:
            shows[f] = shows[over[f]]


@entry
def draw_bands(
    data: Data, bands: tuple[int, int], lists: Lists, window: tuple[int, int], scratch: Scratch, owners: Owners,
    light: Float32s, rate: Float32s
) -> tuple[int, int]:  # fmt: skip
    """Draw the bands from the first to before the last; return the one that needs more room and how much, or (-1, 0).

    Parameters
    ----------
    bands : first, and the one after the last.
    window : first column to write, and the one after the last.
    owners : empty arrays if not requested.
    """
    height, width = light.shape
    for number in range(bands[0], bands[1]):
        band = Band(number, number * BAND, min((number + 1) * BAND, height))
        rows = slice(band.first_row, band.end_row)
        listed = lists.listed[lists.starts[number] : lists.starts[number + 1]]
        c0, c1 = _extent(data.facets, listed, width)
        if c0 >= c1:
            light[rows, window[0] : window[1]] = 0.0
            rate[rows, window[0] : window[1]] = 0.0
            if len(owners.facets) > 0:
                owners.facets[rows, window[0] : window[1]] = -1
            continue
        # Only columns that facets touch are cleared and read; samples are one more on each side.
        scratch.acc[:, c0 : c1 + 1] = 0.0
        scratch.depth[:, c0 : c1 + 2] = 0.0
        scratch.nearest[:, c0 : c1 + 2] = -1
        fill_depth(data, listed, scratch.depth, scratch.nearest, scratch.held, band)
        mark_seen(scratch.nearest, (c0, c1 + 2), scratch.shows, number)
        _mark_hidden_samples(data, listed, band, scratch)
        for f in listed:
            if scratch.shows[f] == number:
                add_facet(scratch.acc, f, scratch.shows, data, band, width)
        n = _sum_up(band, Columns(c0, c1, window[0], window[1]), data.facets, scratch, owners, light, rate)
        if n == 0:
            continue
        lacking = _one_by_one(data, listed, n, band, (c0, c1), scratch)
        if lacking > 0:
            return number, lacking
        for k in range(n):
            row, column = scratch.places[k, 0], scratch.places[k, 1]
            light[row, column], rate[row, column] = scratch.answers[k, 0], scratch.answers[k, 1]
    return -1, 0
