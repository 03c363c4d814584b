"""Sums along rows: every edge is added once to the pixels that it crosses and to the sums for those further right.

Accumulators of a pixel (8 float64, one cache line), the pixel left of the frame first:

    0, 1    area inside, area for each pixel further right
    2, 3, 4 light inside, light for each further right, and its growth a column
    5, 6, 7 the same for the rate
"""

from __future__ import annotations

import math
from typing import NamedTuple

from emulator.raster.layout import Band, Data, G, L, Plane, Sign
from emulator.raster.pixel import flux, is_still, is_zero, less, piece, plane_of
from emulator.sensor.numerics.compiled import lane, vector_kernel
from firmware_protocol.events import Floats, Int32s


class _Edge(NamedTuple):
    """An edge on the screen, y ascending from end a to end b, and q = vx dy - vy dx at both."""

    ax: float
    ay: float
    bx: float
    by: float
    qa: float
    qb: float


class _Jump(NamedTuple):
    """Contribution of an edge to the pixels right of it: area, and the planes of radiance and rate."""

    area: float
    light: Plane
    rate: Plane


@lane
def _carry(cell: Floats, h: float, middle: float, area: float, light: Plane, rate: Plane) -> None:
    """Add the sums for pixels right of a piece; `light`, `rate` are planes in the row's frame, `middle` the mean y."""
    cell[1] += area * h
    cell[3] += h * (light.origin + light.down * middle)
    cell[4] += h * light.right
    cell[6] += h * (rate.origin + rate.down * middle)
    cell[7] += h * rate.right


@vector_kernel
def _add_edge(acc: Floats, edge: _Edge, jump: _Jump, band: Band, width: int) -> None:
    """Add an edge to the accumulators, (rows, width + 1, 8)."""
    ax, ay, bx, by, qa, qb = edge
    area, whole_light, whole_rate = jump
    first, last = band.first_row, band.end_row
    dx, dy = bx - ax, by - ay
    dq = qb - qa
    moves = qa != 0.0 or qb != 0.0
    # The share of the edge up to a place, for the flux, by y or by x: by the longer one, which loses less to rounding.
    steep = dy >= abs(dx)
    per_length = 1.0 / dy if steep else 1.0 / dx
    row = math.floor(max(ay, float(first)))
    slope = dx / dy if dy > 0.0 else 0.0
    rise = dy / dx if dx != 0.0 else 0.0
    rightward = dx >= 0.0
    y, x = ay, ax
    if ay < first:
        y = float(first)
        x = ax + (y - ay) * slope
    while row < last:
        # The part of the edge within the row, from x, y to x_end, y_end.
        y_end, x_end = row + 1.0, bx
        ends_in_row = by <= y_end
        if ends_in_row:
            y_end = by
        else:
            x_end = ax + (y_end - ay) * slope
            x_end = min(max(x_end, min(ax, bx)), max(ax, bx))
        light = Plane(whole_light.origin + whole_light.down * row, whole_light.right, whole_light.down)
        rate = Plane(whole_rate.origin + whole_rate.down * row, whole_rate.right, whole_rate.down)
        line = acc[row - first]
        y0, x0 = y, x
        if x0 < 0.0:  # the part left of the frame adds only to the sums for pixels further right
            y_in = y_end if x_end < 0.0 else y0 - x0 * rise
            _carry(line[0], y_in - y0, 0.5 * (y0 + y_in) - row, area, light, rate)
            x0, y0 = 0.0 if x_end >= 0.0 else width + 1.0, y_in
        elif x_end < width < x0:  # the part right of the frame adds nothing
            y0 += (width - x0) * rise
            x0 = float(width)
        column = math.floor(min(x0, width + 1.0))
        if not rightward and column == x0:
            column -= 1
        while 0 <= column < width:
            # The piece within the pixel, from x0, y0 to x1, y1: to the edge's end in the row, or the pixel's side.
            x1, y1 = x_end, y_end
            done = True
            if rightward:
                if x_end > column + 1.0:
                    x1, done = column + 1.0, False
            elif x_end < column:
                x1, done = float(column), False
            if not done:
                y1 = min(max(y0 + (x1 - x0) * rise, y0), y_end)
            cell = line[column + 1]
            # Integrals right of the piece in the pixel's frame, in which the planes begin at `light_at`, `rate_at`.
            p, q = x0 - column, x1 - column
            v0, v1 = y0 - row, y1 - row
            a, mx, my = piece(p, v0, q, v1)
            light_at, rate_at = light.origin + light.right * column, rate.origin + rate.right * column
            cell[0] += area * a
            cell[2] += light_at * a + light.right * mx + light.down * my
            local_rate = rate_at * a + rate.right * mx + rate.down * my
            if moves:  # light flows through a moving edge
                t0, t1 = (x0 - ax) * per_length, (x1 - ax) * per_length
                if steep:
                    t0, t1 = (y0 - ay) * per_length, (y1 - ay) * per_length
                l0, l1 = light_at + light.right * p + light.down * v0, light_at + light.right * q + light.down * v1
                local_rate -= flux(t1 - t0, l0, l1, qa + dq * t0, qa + dq * t1)
            cell[5] += local_rate
            _carry(cell, y1 - y0, 0.5 * (v0 + v1), area, light, rate)
            if done:
                break
            x0, y0 = x1, y1
            column += 1 if rightward else -1
        if x_end < 0.0 <= x0 <= width:  # the rest of an edge that leaves to the left
            _carry(line[0], y_end - y0, 0.5 * (y0 + y_end) - row, area, light, rate)
        if ends_in_row:
            break
        y, x = y_end, x_end
        row += 1


@lane
def _scaled(k: float, plane: Plane) -> Plane:
    return Plane(k * plane.origin, k * plane.right, k * plane.down)


@lane
def add_facet(acc: Floats, f: int, shows: Int32s, data: Data, band: Band, width: int) -> None:
    """Add the edges of a facet that shows; an edge between two such facets is added by the first of them."""
    vertices, faces, facets, over = data.vertices, data.faces, data.facets, data.over[f]
    sign = facets[f, Sign]
    for side in range(3):
        g = data.across[f, side]
        shared = g >= 0 and shows[g] == band.number
        if shared and g < f:
            continue
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay = vertices[a, 0], vertices[a, 1]
        bx, by = vertices[b, 0], vertices[b, 1]
        # The jump is that from nothing to the facet, from the facet below to a patch, or from the neighbour.
        area = sign
        light, rate = _scaled(sign, plane_of(facets, f, L)), _scaled(sign, plane_of(facets, f, G))
        if over >= 0:
            area = 0.0
            light = less(light, sign, plane_of(facets, over, L))
            rate = less(rate, sign, plane_of(facets, over, G))
        still = False
        if shared:
            other_sign = facets[g, Sign]
            still = is_still(data, f, side)
            area -= other_sign
            light = less(light, other_sign, plane_of(facets, g, L))
            rate = less(rate, other_sign, plane_of(facets, g, G))
        if area == 0.0 and is_zero(light) and is_zero(rate):
            continue  # between two black facets, as half of a body's are
        qa = qb = 0.0
        dx, dy = bx - ax, by - ay
        if not still:
            qa = vertices[a, 2] * dy - vertices[a, 3] * dx
            qb = vertices[b, 2] * dy - vertices[b, 3] * dx
        # A level edge has no area on its right, but light flows through it where it moves.
        if dy == 0.0 and (dx == 0.0 or (qa == 0.0 and qb == 0.0)):
            continue
        if max(ay, by) < band.first_row or min(ay, by) >= band.end_row or min(ax, bx) >= width:
            continue
        if dy >= 0.0:
            _add_edge(acc, _Edge(ax, ay, bx, by, qa, qb), _Jump(area, light, rate), band, width)
        else:  # the other way round all signs change; those of the flux twice
            turned = _Jump(-area, _scaled(-1.0, light), _scaled(-1.0, rate))
            _add_edge(acc, _Edge(bx, by, ax, ay, -qb, -qa), turned, band, width)
