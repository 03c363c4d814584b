"""Light and rate of a pixel from exact visible intervals on a few lines through it.

On a line each facet is an interval, its radiance and 1 / depth linear. From left to right the nearest interval is
followed until it ends, until a nearer one begins or until another one passes through it. The integral over the
intervals is exact; over LINES lines across the pixel's contents it is the midpoint rule. Where the visible facet
changes at the place x, the rate gets (L_left - L_right) u with u = v_x - v_y dx/dy of the edge that ends there, and for
surfaces that pass through each other the velocity of equal depth.
"""

from __future__ import annotations

from emulator.raster.compiled import lane, vector_kernel
from emulator.raster.layout import FLAT, Data, Floats, G, Ints, L, W, WHighest, WLowest

__all__ = ["LINES", "LINE_FIELDS", "SIDE_FIELDS", "resolve"]

LINES = 6  # with 4 the 99th percentile of rate errors on Itokawa's outlines is 12 % of the rms, with 6 it is 8 %
LINE_FIELDS = 11
SIDE_FIELDS = 21
_SHORTEST = 1e-9  # px
_FROM, _TO, _FROM_SIDE, _TO_SIDE, _W, _WX, _L, _LX, _G, _GX, _FACET = range(LINE_FIELDS)
_Y_LOW, _Y_MIDDLE, _Y_HIGH, _X_LOW, _X_MIDDLE, _LONG, _LOWER, _UPPER, _LONG_SIDE, _LOWER_SIDE, _UPPER_SIDE = range(11)
_OF, _PLANES = 11, 12


@lane
def resolve(
    data: Data,
    place: tuple[int, int],
    listed: Ints,
    scratch: tuple[Floats, Floats],
    upright: bool,
) -> tuple[float, float]:
    """Return light and rate of a pixel; `upright` lines are columns, others rows.

    Parameters
    ----------
    scratch : (n, SIDE_FIELDS) and (n, LINE_FIELDS) or longer.
    """
    sides, lines = scratch
    o = 1 if upright else 0
    low, high = 1.0, 0.0
    for i in range(len(listed)):
        out = sides[i]
        _set_sides(data, place, listed[i], o, out)
        _set_planes(data, place, listed[i], o, out)
        low, high = min(low, out[_Y_LOW]), max(high, out[_Y_HIGH])
    low, high = max(low, 0.0), min(high, 1.0)
    apart = max(high - low, 0.0) / LINES
    light = rate = 0.0
    for k in range(LINES):
        line = (o, low + (k + 0.5) * apart)
        n = _cut(sides, len(listed), line[1], lines)
        more, changing = _along(data, lines, n, place, line)
        light, rate = light + more, rate + changing
    return light * apart, rate * apart


@lane
def _side_of(i: int, j: int) -> int:
    """Return the side between two corners of a facet."""
    return i if j == i + 1 or j == i - 2 else j


@lane
def _set_sides(data: Data, place: tuple[int, int], f: int, o: int, out: Floats) -> None:
    """Write a facet's sides in the pixel's frame: corners by ascending y, and the growth of x with y on each side."""
    vertices, faces = data[0], data[1]
    x, y = place[o], place[1 - o]
    i, j, k = 0, 1, 2
    if vertices[faces[f, i], 1 - o] > vertices[faces[f, j], 1 - o]:
        i, j = j, i
    if vertices[faces[f, j], 1 - o] > vertices[faces[f, k], 1 - o]:
        j, k = k, j
    if vertices[faces[f, i], 1 - o] > vertices[faces[f, j], 1 - o]:
        i, j = j, i
    a, b, c = faces[f, i], faces[f, j], faces[f, k]
    ax, ay, bx, by = vertices[a, o] - x, vertices[a, 1 - o] - y, vertices[b, o] - x, vertices[b, 1 - o] - y
    cx, cy = vertices[c, o] - x, vertices[c, 1 - o] - y
    out[_Y_LOW], out[_Y_MIDDLE], out[_Y_HIGH], out[_X_LOW], out[_X_MIDDLE] = ay, by, cy, ax, bx
    out[_LONG], out[_LOWER], out[_UPPER] = (cx - ax) / (cy - ay), (bx - ax) / (by - ay), (cx - bx) / (cy - by)
    out[_LONG_SIDE], out[_LOWER_SIDE], out[_UPPER_SIDE] = _side_of(i, k), _side_of(i, j), _side_of(j, k)


@lane
def _set_planes(data: Data, place: tuple[int, int], f: int, o: int, out: Floats) -> None:
    """Write a facet's planes in the pixel's frame: value at its origin, along x and along y."""
    facets = data[4]
    x, y = place[o], place[1 - o]
    out[_OF] = f
    for k in range(3):
        at, to = (W, L, G)[k], _PLANES + 3 * k
        out[to + 1], out[to + 2] = facets[f, at + 1 + o], facets[f, at + 2 - o]
        out[to] = facets[f, at] + out[to + 1] * x + out[to + 2] * y
    if data[5][f] == FLAT:
        out[_PLANES] = min(max(out[_PLANES], facets[f, WLowest]), facets[f, WHighest])


@lane
def _cut(sides: Floats, count: int, y: float, lines: Floats) -> int:
    """Write the interval of each facet on a line, in the pixel's frame; return their number."""
    n = 0
    for i in range(count):
        facet = sides[i]
        if not facet[_Y_LOW] <= y < facet[_Y_HIGH]:
            continue
        xa, from_side = facet[_X_LOW] + (y - facet[_Y_LOW]) * facet[_LONG], facet[_LONG_SIDE]
        if y < facet[_Y_MIDDLE]:
            xb, to_side = facet[_X_LOW] + (y - facet[_Y_LOW]) * facet[_LOWER], facet[_LOWER_SIDE]
        else:
            xb, to_side = facet[_X_MIDDLE] + (y - facet[_Y_MIDDLE]) * facet[_UPPER], facet[_UPPER_SIDE]
        if xa > xb:
            xa, xb, from_side, to_side = xb, xa, to_side, from_side
        if xb <= 0.0 or xa >= 1.0 or xb - xa <= _SHORTEST:
            continue
        out = lines[n]
        out[_FROM], out[_TO], out[_FROM_SIDE], out[_TO_SIDE], out[_FACET] = xa, xb, from_side, to_side, facet[_OF]
        for k in range(3):
            at, to = _PLANES + 3 * k, _W + 2 * k
            out[to] = facet[at] + facet[at + 2] * y
            out[to + 1] = facet[at + 1]
        n += 1
    return n


@lane
def _value(lines: Floats, k: int, at: int, x: float) -> float:
    value: float = lines[k, at] + lines[k, at + 1] * x
    return value


@vector_kernel
def _nearest(lines: Floats, n: int, x: float) -> int:
    """Return the nearest interval right of x, -1 for none."""
    best, nearest = -1, 0.0
    at = x + _SHORTEST
    for k in range(n):
        if lines[k, _FROM] <= at < lines[k, _TO]:
            w = _value(lines, k, _W, at)
            if best < 0 or w > nearest:
                best, nearest = k, w
    return best


@lane
def _change(lines: Floats, n: int, w: int, x: float) -> tuple[float, int, bool]:
    """Return the end of interval `w`, nearest at x, its successor (-1: to be searched), and whether it is crossed."""
    end, heir, passed = lines[w, _TO], -1, False
    for k in range(n):
        if k == w:
            continue
        start, stop = max(x, lines[k, _FROM]), min(end, lines[k, _TO])
        if stop - start <= _SHORTEST:
            continue
        first = _value(lines, k, _W, start) - _value(lines, w, _W, start)
        last = _value(lines, k, _W, stop) - _value(lines, w, _W, stop)
        rounding = 1e-12 * abs(lines[w, _W])
        if first > rounding and start > x + _SHORTEST:
            end, heir, passed = start, k, False
        elif last > rounding:
            cross = start + (stop - start) * (-first / (last - first)) if first < 0.0 else start
            if cross < end - _SHORTEST and cross > x + _SHORTEST:
                end, heir, passed = cross, k, True
    return end, heir, passed


@lane
def _along(
    data: Data,
    lines: Floats,
    n: int,
    place: tuple[int, int],
    line: tuple[int, float],
) -> tuple[float, float]:
    """Return the integrals of light and rate along a line."""
    light = rate = 0.0
    x, w = 0.0, _nearest(lines, n, 0.0)
    for _ in range(4 * n + 4):
        if w < 0:
            end, heir = 2.0, -1
            for k in range(n):
                if x < lines[k, _FROM] < end:
                    end = lines[k, _FROM]
            if end >= 1.0:
                break
            following = _nearest(lines, n, end)
            if following >= 0:
                rate -= _value(lines, following, _L, end) * _speed(data, lines, following, _FROM_SIDE, place, line)
        else:
            end, heir, passed = _change(lines, n, w, x)
            stop = min(end, 1.0)
            middle = 0.5 * (x + stop)
            light += (stop - x) * _value(lines, w, _L, middle)
            rate += (stop - x) * _value(lines, w, _G, middle)
            if end >= 1.0:
                break
            following = heir if heir >= 0 else _nearest(lines, n, end)
            step = _value(lines, w, _L, end)
            if following >= 0:
                step -= _value(lines, following, _L, end)
            if passed:
                rate += step * _equal_depth_speed(data, lines, w, heir, end, place, line)
            elif heir >= 0:
                rate += step * _speed(data, lines, heir, _FROM_SIDE, place, line)
            else:
                rate += step * _speed(data, lines, w, _TO_SIDE, place, line)
        x, w = end, following
    return light, rate


@lane
def _speed(data: Data, lines: Floats, k: int, which: int, place: tuple[int, int], line: tuple[int, float]) -> float:
    """Return the velocity of an interval's end along the line."""
    vertices, faces = data[0], data[1]
    f, side = int(lines[k, _FACET]), int(lines[k, which])
    a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
    o, y = line
    along, across = vertices[b, o] - vertices[a, o], vertices[b, 1 - o] - vertices[a, 1 - o]
    t = (y + place[1 - o] - vertices[a, 1 - o]) / across
    v_along = vertices[a, 2 + o] + t * (vertices[b, 2 + o] - vertices[a, 2 + o])
    v_across = vertices[a, 3 - o] + t * (vertices[b, 3 - o] - vertices[a, 3 - o])
    speed: float = v_along - v_across * (along / across)
    return speed


@lane
def _equal_depth_speed(
    data: Data,
    lines: Floats,
    k: int,
    m: int,
    x: float,
    place: tuple[int, int],
    line: tuple[int, float],
) -> float:
    """Return the velocity along the line of the point where two facets have equal depth."""
    o, y = line
    spot = (place[o] + x, place[1 - o] + y)
    difference = _inverse_depth_rate(data, int(lines[k, _FACET]), spot, o) - _inverse_depth_rate(
        data, int(lines[m, _FACET]), spot, o
    )
    slope = lines[k, _WX] - lines[m, _WX]
    return -difference / slope if slope != 0.0 else 0.0


@vector_kernel
def _inverse_depth_rate(data: Data, f: int, spot: tuple[float, float], o: int) -> float:
    """Return the rate of a facet's 1 / depth at a fixed point of the screen."""
    vertices, faces, facets = data[0], data[1], data[4]
    a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
    x, y = spot[o], spot[1 - o]
    wx, wy = facets[f, W + 1], facets[f, W + 2]
    e1x, e1y = vertices[b, 0] - vertices[a, 0], vertices[b, 1] - vertices[a, 1]
    e2x, e2y = vertices[c, 0] - vertices[a, 0], vertices[c, 1] - vertices[a, 1]
    det = e1x * e2y - e1y * e2x
    px, py = x - vertices[a, 0], y - vertices[a, 1]
    share_b, share_c = (px * e2y - py * e2x) / det, (e1x * py - e1y * px) / det
    total = 0.0
    for v, share in ((a, 1.0 - share_b - share_c), (b, share_b), (c, share_c)):
        total += share * (vertices[v, 5] - wx * vertices[v, 2] - wy * vertices[v, 3])
    return total
