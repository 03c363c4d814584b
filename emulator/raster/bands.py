"""Drawing of a light frame in bands of rows, each in one pass.

1. Depth: the nearest 1 / depth at the middle of each pixel and of one more all around.
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

import numpy as np
import numpy.typing as npt

from emulator.raster.compiled import entry, kernel, lane
from emulator.raster.depth import alone, fill_depth, mark_seen
from emulator.raster.depth import shows as may_show
from emulator.raster.layout import (
    BAND,
    Data,
    Float32s,
    Floats,
    G,
    Ints,
    L,
    XHigh,
    XLow,
    YHigh,
    YLow,
)
from emulator.raster.pixel import TOLERANCE, pixel_light
from emulator.raster.rows import add_facet

_EMPTY = 1e-9  # of a pixel: less is rounding of sums along a row


@lane
def _extent(facets: Floats, listed: Ints, width: int) -> tuple[int, int]:
    """Return the first column that facets touch and the one after the last."""
    low, high = width, 0
    for f in listed:
        low = min(low, int(min(max(facets[f, XLow], 0.0), width - 1.0)))
        high = max(high, int(min(max(facets[f, XHigh], 0.0), width - 1.0)) + 1)
    return low, high


@lane
def _sum_up(
    acc: Floats,
    rows: tuple[int, int],
    columns: tuple[int, int, int, int],
    pictures: tuple[Float32s, Float32s],
    facets: Floats,
    nearest: Ints,
    places: tuple[Ints, Ints, Ints],
    owners: tuple[Ints, Float32s],
) -> int:
    """Write pixels whose area is a whole number; list the others, number them in `slots`; return their number."""
    n = 0
    owner, whole = owners
    told = len(owner) > 0
    light, rate = pictures
    slots, found, masks = places
    c0, c1, left, right = columns
    for r in range(rows[1] - rows[0]):
        row = rows[0] + r
        for c in range(left, c0):
            light[row, c] = rate[row, c] = 0.0
        for c in range(c1, right):
            light[row, c] = rate[row, c] = 0.0
        if told:
            owner[row, left:right], whole[row, left:right] = -1, 1.0
            for c in range(c0, c1):
                owner[row, c] = nearest[r + 1, c + 1]
        cell = acc[r, c0]
        area, l0, l1, g0, g1 = cell[1], cell[3], cell[4], cell[6], cell[7]
        for c in range(c0, c1):
            cell = acc[r, c + 1]
            here = area + cell[0]
            value = cell[2] + l0 + l1 * (c + 0.5)
            changing = cell[5] + g0 + g1 * (c + 0.5)
            area, l0, l1, g0, g1 = area + cell[1], l0 + cell[3], l1 + cell[4], g0 + cell[6], g1 + cell[7]
            if abs(here) <= _EMPTY:
                value, changing = 0.0, cell[5]  # an edge that enters just now
            elif abs(here - 1.0) > TOLERANCE:
                f = alone(nearest, r, c)
                if f >= 0 and abs(here - round(here)) <= TOLERANCE:
                    x, y = c + 0.5, row + 0.5
                    value = facets[f, L] + facets[f, L + 1] * x + facets[f, L + 2] * y
                    changing = facets[f, G] + facets[f, G + 1] * x + facets[f, G + 2] * y
                else:
                    slots[r, c] = n
                    masks[c] |= 1 << r
                    found[n, 0], found[n, 1] = row, c
                    n += 1
                    if told:
                        whole[row, c] = abs(2.0 * (here - math.floor(here)) - 1.0)
            light[row, c] = max(value, 0.0)
            rate[row, c] = changing
    return n


@lane
def _pair_up(
    data: Data,
    listed: Ints,
    places: tuple[Ints, Ints, Ints],
    pairs: Ints,
    rows: tuple[int, int],
    columns: tuple[int, int],
) -> int:
    """Write (slot, facet) of each listed pixel that a facet touches; return their number, beyond the room too."""
    vertices, faces, facets = data[0], data[1], data[4]
    slots, _, masks = places
    n = 0
    for f in listed:
        r0, r1 = int(max(facets[f, YLow], rows[0])), int(min(facets[f, YHigh], rows[1] - 1.0))
        if facets[f, XHigh] < columns[0] or facets[f, XLow] >= columns[1] or facets[f, YHigh] < rows[0]:
            continue
        b0, b1 = int(max(facets[f, XLow], columns[0])), int(min(facets[f, XHigh], columns[1] - 1.0))
        wanted = ((2 << (r1 - rows[0])) - 1) & ~((1 << (r0 - rows[0])) - 1)
        while b0 <= b1 and masks[b0] & wanted == 0:
            b0 += 1
        while b1 >= b0 and masks[b1] & wanted == 0:
            b1 -= 1
        if b0 > b1:
            continue
        for r in range(r0, r1 + 1):
            line = slots[r - rows[0]]
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
def _strip(vertices: Floats, faces: Ints, f: int, row: int) -> tuple[float, float]:
    """Return the least and the largest column of a facet within a row."""
    left, right = 1e300, -1e300
    low, high = float(row), row + 1.0
    for side in range(3):
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay, bx, by = vertices[a, 0], vertices[a, 1], vertices[b, 0], vertices[b, 1]
        if low <= ay <= high:
            left, right = min(left, ax), max(right, ax)
        for y in (low, high):
            if (ay < y) != (by < y):
                x = ax + (y - ay) / (by - ay) * (bx - ax)
                left, right = min(left, x), max(right, x)
    return left, right


@lane
def _group(pairs: Ints, n: int, ends: Ints, grouped: Ints) -> None:
    """Sort facets by slot, keeping their order: those of slot k end at ends[k]."""
    ends[:] = 0
    for i in range(n):
        ends[pairs[i, 0]] += 1
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
def _one_by_one(
    data: Data,
    here: Ints,
    n: int,
    rows: tuple[int, int],
    columns: tuple[int, int],
    scratch: Data,
) -> int:
    """Write light and rate of the first n `found` pixels to `answers`; return 0, or the pairs that lack room."""
    slots, found, masks, answers, ends, pairs, grouped, keys, sides, lines = scratch[5:]
    count: int = _pair_up(data, here, (slots, found, masks), pairs, rows, columns)
    masks[columns[0] : columns[1]] = 0
    for k in range(n):
        slots[found[k, 0] - rows[0], found[k, 1]] = -1
    if count > len(pairs):
        return count
    _group(pairs, count, ends[:n], grouped)
    begin = 0
    for k in range(n):
        value, changing = pixel_light(data, (found[k, 1], found[k, 0]), grouped[begin : ends[k]], keys, (sides, lines))
        answers[k, 0], answers[k, 1] = max(value, 0.0), changing
        begin = ends[k]
    return 0


@lane
def _mark_others(data: Data, here: Ints, marks: tuple[Ints, Ints], depth: Floats, rows: tuple[int, int, int]) -> None:
    """Mark the facets that may show although they hold no sample; patches show where their facets do.

    A patch has no area, so the sum of areas would not show that one is missing.
    """
    over, (shows, held), (first, last, band) = data[6], marks, rows
    for f in here:
        if over[f] >= 0 and shows[f] == band:
            shows[over[f]] = band
    for f in here:
        if over[f] < 0 and shows[f] != band and held[f] != band and may_show(data[4], f, depth, first, last):
            shows[f] = band
    for f in here:
        if over[f] >= 0:
            shows[f] = shows[over[f]]


@entry
def query_bands(
    data: Data,
    lists: Data,
    pixels: npt.NDArray[np.int64],
    begin: int,
    shape: tuple[int, int],
    scratch: Data,
    out: Floats,
) -> tuple[int, int]:
    """Write light and rate, (n, 2), of pixels in ascending order; return the last index and the missing room."""
    starts, listed = lists
    slots, found, masks, answers = scratch[5:9]
    height, width = shape
    k = begin
    while k < len(pixels):
        band = pixels[k] // width // BAND
        first, last = band * BAND, min((band + 1) * BAND, height)
        n = 0
        c0, c1 = width, 0
        while k + n < len(pixels) and pixels[k + n] < last * width:
            row, column = pixels[k + n] // width, pixels[k + n] % width
            found[n, 0], found[n, 1] = row, column
            slots[row - first, column] = n
            masks[column] |= 1 << (row - first)
            c0, c1 = min(c0, column), max(c1, column + 1)
            n += 1
        lacking = _one_by_one(data, listed[starts[band] : starts[band + 1]], n, (first, last), (c0, c1), scratch)
        if lacking > 0:
            return k, lacking
        out[k : k + n] = answers[:n]
        k += n
    return k, 0


@entry
def draw_bands(
    data: Data,
    bands: tuple[int, int],
    lists: Data,
    window: tuple[int, int],
    scratch: Data,
    light: Float32s,
    rate: Float32s,
    owners: tuple[Ints, Float32s],
) -> tuple[int, int]:
    """Draw the bands from the first to before the last; return the one that needs more room and how much, or (-1, 0).

    Parameters
    ----------
    data : vertices, faces, across, smooth, facets, kinds, over.
    bands : first, last.
    lists : `starts` and `listed` of `projection.bucket`.
    window : first column to write, and the one after the last.
    scratch : see `renderer.Scratch`.
    owners : of `renderer.Owners`; empty arrays if not requested.
    """
    starts, listed = lists
    acc, depth, nearest, held, shows, slots, found, masks, answers = scratch[:9]
    facets = data[4]
    places = (slots, found, masks)
    height, width = light.shape
    for band in range(bands[0], bands[1]):
        here = listed[starts[band] : starts[band + 1]]
        first, last = band * BAND, min((band + 1) * BAND, height)
        c0, c1 = _extent(facets, here, width)
        if c0 >= c1:
            light[first:last, window[0] : window[1]] = 0.0
            rate[first:last, window[0] : window[1]] = 0.0
            if len(owners[0]) > 0:
                owners[0][first:last, window[0] : window[1]] = -1
            continue
        acc[:, c0 : c1 + 1] = 0.0
        depth[:, c0 : c1 + 2] = 0.0
        nearest[:, c0 : c1 + 2] = -1
        fill_depth(data, here, depth, nearest, held, (first, last, band))
        mark_seen(nearest, (c0, c1 + 2), shows, band)
        _mark_others(data, here, (shows, held), depth, (first, last, band))
        for f in here:
            if shows[f] == band:
                add_facet(acc, f, shows, band, data, (first, last, width))
        n = _sum_up(acc, (first, last), (c0, c1, window[0], window[1]), (light, rate), facets, nearest, places, owners)
        if n == 0:
            continue
        count = _one_by_one(data, here, n, (first, last), (c0, c1), scratch)
        if count > 0:
            return band, count
        for k in range(n):
            row, column = found[k, 0], found[k, 1]
            light[row, column], rate[row, column] = answers[k, 0], answers[k, 1]
    return -1, 0
