"""Light and rate of one pixel from the facets that touch it.

Facets are processed by nearness. While they fill the pixel without overlap their integrals are exact, and once they
fill it, everything farther than all of them is hidden. A pixel with free space where a single outline enters and leaves
once is exact too: there is nothing behind. All others are resolved on LINES lines across the outline (`lines`).

The integral of a function over a facet is a sum over the facet's edges: each edge a -> b adds the area between it and
the right end of the row. In the pixel that the edge crosses this is `piece`; pixels further right get the rest as sums
along the row (`bands`) or directly (`integrals`). With h = y1 - y0, p and q the columns of the ends less the pixel's:

    area        h (ua + ub) / 2,  ua = 1 - p, ub = 1 - q
    of x        h / 2 (1 - (p^2 + p q + q^2) / 3)
    of y        h / 6 (y0 (2 ua + ub) + y1 (ua + 2 ub))
    flux        w / 6 (l0 (2 q0 + q1) + l1 (q0 + 2 q1)),  q = vx dy - vy dx, w the piece's share of the edge, l the
                function on the edge

The time derivative of an integral of L is that of G less the flux of L through the moving edge (Reynolds' theorem).
"""

from __future__ import annotations

from emulator.raster.layout import (
    CULLED,
    SHOWABLE,
    Data,
    G,
    L,
    Plane,
    Scratch,
    Sign,
    W,
    WHighest,
    WLowest,
    XHigh,
    XLow,
    YHigh,
    YLow,
)
from emulator.raster.lines import resolve
from emulator.sensor.numerics.compiled import lane
from firmware_protocol.events import Floats, Int32s


@lane
def piece(p: float, y0: float, q: float, y1: float) -> tuple[float, float, float]:
    """Return the integrals of 1, x and y between an edge's piece and its pixel's right side; pixel's own frame."""
    h = y1 - y0
    ua, ub = 1.0 - p, 1.0 - q
    of_x = 0.5 * h * (1.0 - (p * p + p * q + q * q) * (1.0 / 3.0))
    of_y = h * (1.0 / 6.0) * (y0 * (2.0 * ua + ub) + y1 * (ua + 2.0 * ub))
    return 0.5 * h * (ua + ub), of_x, of_y


@lane
def flux(share: float, l0: float, l1: float, q0: float, q1: float) -> float:
    """Return the flux of a function with the values l0, l1 at a piece's ends, moving with q0, q1."""
    return share * (1.0 / 6.0) * (l0 * (2.0 * q0 + q1) + l1 * (q0 + 2.0 * q1))


@lane
def plane_of(facets: Floats, f: int, at: int) -> Plane:
    """Return a facet's plane, of L, G or W."""
    return Plane(facets[f, at], facets[f, at + 1], facets[f, at + 2])


@lane
def less(plane: Plane, share: float, other: Plane) -> Plane:
    """Return plane - share * other."""
    return Plane(
        plane.origin - share * other.origin, plane.right - share * other.right, plane.down - share * other.down
    )


@lane
def is_zero(plane: Plane) -> bool:
    """Return whether a plane is 0 everywhere."""
    return plane.origin == 0.0 and plane.right == 0.0 and plane.down == 0.0


@lane
def is_still(data: Data, f: int, side: int) -> bool:
    """Return whether light is continuous across a side, so that no flux passes: the neighbour shares its radiance."""
    g = data.across[f, side]
    same: bool = data.facets[g, Sign] == data.facets[f, Sign]
    gradients = bool(data.kinds[f] == SHOWABLE and data.kinds[g] == SHOWABLE)
    return same and gradients and bool(data.smooth[f, side] != 0)


_BEFORE = 1.0 + 1e-9
TOLERANCE = 1e-6
"""Area, in pixels, below which gaps and overlaps count as rounding."""


@lane
def depth_range(facets: Floats, f: int, column: int, row: int) -> tuple[float, float]:
    """Return bounds of 1 / depth of a facet in a pixel."""
    middle = facets[f, W] + facets[f, W + 1] * (column + 0.5) + facets[f, W + 2] * (row + 0.5)
    half = 0.5 * (abs(facets[f, W + 1]) + abs(facets[f, W + 2]))
    low, high = facets[f, WLowest], facets[f, WHighest]
    return min(max(middle - half, low), high), max(min(middle + half, high), low)


@lane
def _sort(order: Int32s, keys: Floats, n: int) -> None:
    """Sort by descending keys (Shell's method: needs no memory); equal keys by ascending entry."""
    gap = 1
    while gap < n // 3:
        gap = 3 * gap + 1
    while gap > 0:
        for i in range(gap, n):
            key, entry = keys[i], order[i]
            j = i
            while j >= gap and (keys[j - gap] < key or (keys[j - gap] == key and order[j - gap] > entry)):
                keys[j], order[j] = keys[j - gap], order[j - gap]
                j -= gap
            keys[j], order[j] = key, entry
        gap //= 3


@lane
def _contains(vertices: Floats, faces: Int32s, facets: Floats, f: int, column: int, row: int) -> bool:
    """Return whether a facet contains the whole pixel."""
    if facets[f, XLow] > column or facets[f, XHigh] < column + 1 or facets[f, YLow] > row or facets[f, YHigh] < row + 1:
        return False
    inside = True
    for side in range(3):
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay = vertices[a, 0], vertices[a, 1]
        dx, dy = vertices[b, 0] - ax, vertices[b, 1] - ay
        beyond = (dy * (column + 0.5 - ax) - dx * (row + 0.5 - ay)) * facets[f, Sign]
        inside = inside and beyond >= 0.5 * (abs(dx) + abs(dy))
    return inside


@lane
def integrals(data: Data, f: int, column: int, row: int) -> tuple[float, float, float]:
    """Return area, light and rate of a facet within a pixel, exact; of a patch no area, and the difference of light."""
    vertices, faces, facets, over = data.vertices, data.faces, data.facets, data.over[f]
    area = light = rate = 0.0
    layer = 1.0  # area of a pixel that the facet fills
    light_plane, rate_plane = plane_of(facets, f, L), plane_of(facets, f, G)
    if over >= 0:
        layer = 0.0
        light_plane = less(light_plane, 1.0, plane_of(facets, over, L))
        rate_plane = less(rate_plane, 1.0, plane_of(facets, over, G))
    # Planes in the pixel's frame.
    j0, jx, jy = light_plane
    g0, gx, gy = rate_plane
    j0 += jx * column + jy * row
    g0 += gx * column + gy * row
    if _contains(vertices, faces, facets, f, column, row):
        return layer, j0 + 0.5 * (jx + jy), g0 + 0.5 * (gx + gy)
    for side in range(3):
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay = vertices[a, 0] - column, vertices[a, 1] - row
        bx, by = vertices[b, 0] - column, vertices[b, 1] - row
        dx, dy = bx - ax, by - ay
        t0, t1 = 0.0, 1.0  # the part within the row
        if dy > 0.0:
            t0, t1 = max(t0, -ay / dy), min(t1, (1.0 - ay) / dy)
        elif dy < 0.0:
            t0, t1 = max(t0, (1.0 - ay) / dy), min(t1, -ay / dy)
        elif not 0.0 <= ay < 1.0:
            continue
        if not t0 < t1:
            continue
        s0, s1 = t0, t1  # the part within the column
        if dx > 0.0:
            s0, s1 = max(s0, -ax / dx), min(s1, (1.0 - ax) / dx)
        elif dx < 0.0:
            s0, s1 = max(s0, (1.0 - ax) / dx), min(s1, -ax / dx)
        elif not 0.0 <= ax < 1.0:
            s1 = s0
        left0, left1 = t0, t0  # the part left of the pixel
        if not s0 < s1:
            if ax + 0.5 * (t0 + t1) * dx < 0.0:
                left1 = t1
        elif dx > 0.0:
            left1 = s0
        elif dx < 0.0:
            left0, left1 = s1, t1
        if left0 < left1:  # the whole pixel is right of this part
            h, middle = (left1 - left0) * dy, ay + 0.5 * (left0 + left1) * dy
            area += h
            light += h * (j0 + 0.5 * jx + jy * middle)
            rate += h * (g0 + 0.5 * gx + gy * middle)
        if not s0 < s1:
            continue
        p, q = ax + s0 * dx, ax + s1 * dx
        y0, y1 = ay + s0 * dy, ay + s1 * dy
        within, mx, my = piece(p, y0, q, y1)
        area += within
        light += j0 * within + jx * mx + jy * my
        rate += g0 * within + gx * mx + gy * my
        if not is_still(data, f, side):  # at a still side light is continuous: the fluxes of both facets cancel
            qa = vertices[a, 2] * dy - vertices[a, 3] * dx
            dq = vertices[b, 2] * dy - vertices[b, 3] * dx - qa
            l0, l1 = j0 + jx * p + jy * y0, j0 + jx * q + jy * y1
            rate -= flux(s1 - s0, l0, l1, qa + dq * s0, qa + dq * s1)
    sign = facets[f, Sign]
    return sign * layer * area, sign * light, sign * rate


@lane
def _outline(data: Data, f: int, column: int, row: int) -> tuple[int, float]:
    """Return the crossings of the facet's part of an outline with the pixel's border, and its |dx| - |dy| within."""
    vertices, faces, facets = data.vertices, data.faces, data.facets
    crossings, lean = 0, 0.0
    for side in range(3):
        g = data.across[f, side]
        if g >= 0 and data.kinds[g] != CULLED and facets[g, Sign] == facets[f, Sign]:
            continue  # the surface goes on: no outline
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay = vertices[a, 0] - column, vertices[a, 1] - row
        dx, dy = vertices[b, 0] - column - ax, vertices[b, 1] - row - ay
        t0, t1 = 0.0, 1.0  # the part within the pixel
        if dx != 0.0:
            t0, t1 = max(t0, min(-ax / dx, (1.0 - ax) / dx)), min(t1, max(-ax / dx, (1.0 - ax) / dx))
        elif not 0.0 <= ax <= 1.0:
            continue
        if dy != 0.0:
            t0, t1 = max(t0, min(-ay / dy, (1.0 - ay) / dy)), min(t1, max(-ay / dy, (1.0 - ay) / dy))
        elif not 0.0 <= ay <= 1.0:
            continue
        if t0 < t1:
            crossings += (t0 > 0.0) + (t1 < 1.0)
            lean += (t1 - t0) * (abs(dx) - abs(dy))
    return crossings, lean


@lane
def pixel_light(data: Data, column: int, row: int, listed: Int32s, scratch: Scratch) -> tuple[float, float]:
    """Return light and rate of a pixel; the facets that touch it, `listed`, (n,), are sorted in place."""
    facets, over, keys = data.facets, data.over, scratch.keys
    n = len(listed)
    is_black = True
    for i in range(n):
        f = listed[i]
        is_black = is_black and is_zero(plane_of(facets, f, L)) and is_zero(plane_of(facets, f, G))
        if over[f] >= 0:  # before its facet
            keys[i] = depth_range(facets, over[f], column, row)[1] * _BEFORE
        else:
            keys[i] = depth_range(facets, f, column, row)[1]
    area = light = rate = 0.0
    if is_black:
        return light, rate
    _sort(listed, keys, n)
    farthest = 1e300  # the least 1 / depth of the facets that fill the pixel so far
    for i in range(n):
        if area >= 1.0 - TOLERANCE and keys[i] < farthest:
            n = i  # all others are behind
            break
        covered, its_light, its_rate = integrals(data, listed[i], column, row)
        area, light, rate = area + covered, light + its_light, rate + its_rate
        if area > 1.0 + TOLERANCE:
            break  # facets overlap
        if covered > 0.0:
            farthest = min(farthest, depth_range(facets, listed[i], column, row)[0])
    if abs(area - 1.0) <= TOLERANCE:
        return light, rate
    crossings, lean = 0, 0.0
    for i in range(n):
        if over[listed[i]] < 0:
            its_crossings, its_lean = _outline(data, listed[i], column, row)
            crossings, lean = crossings + its_crossings, lean + its_lean
    if area < 1.0 and crossings == 2:
        return light, rate
    # Lines across the outline: columns where it is more level than upright.
    light, rate = resolve(data, (column, row), listed[:n], scratch, lean > 0.0)
    return light, rate
