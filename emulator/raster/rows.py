"""Sums along rows: every edge is added once to the pixels that it crosses and to the sums for those further right.

Accumulators of a pixel (8 float64, one cache line), the pixel left of the frame first:

    0, 1    area inside, area for each pixel further right
    2, 3, 4 light inside, light for each further right, and its growth a column
    5, 6, 7 the same for the rate
"""

from __future__ import annotations

import math

from emulator.raster.compiled import lane, vector_kernel
from emulator.raster.layout import Data, Floats, G, Ints, L, Plane, Sign
from emulator.raster.pixel import flux, is_still, piece


@lane
def _carry(cell: Floats, h: float, middle: float, area: float, light: Plane, rate: Plane) -> None:
    """Add the sums for pixels right of a piece; `light`, `rate` are planes in the row's frame, `middle` the mean y."""
    cell[1] += area * h
    cell[3] += h * (light[0] + light[2] * middle)
    cell[4] += h * light[1]
    cell[6] += h * (rate[0] + rate[2] * middle)
    cell[7] += h * rate[1]


@vector_kernel
def _add_edge(
    acc: Floats,
    ends: tuple[float, float, float, float],
    moving: tuple[float, float],
    planes: tuple[float, float, float, float, float, float, float],
    rows: tuple[int, int, int],
) -> None:
    """Add an edge whose jump of area, radiance and rate is `planes`.

    Parameters
    ----------
    acc : (rows, width + 1, 8).
    ends : x and y of both ends, y ascending.
    moving : q = vx dy - vy dx at both ends.
    rows : first row, row after the last, width.
    """
    ax, ay, bx, by = ends
    area, j0, jx, jy, g0, gx, gy = planes
    first, last, width = rows
    dx, dy = bx - ax, by - ay
    qa, dq = moving[0], moving[1] - moving[0]
    moves = moving[0] != 0.0 or moving[1] != 0.0
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
        y_end, x_end = row + 1.0, bx
        ends_here = by <= y_end
        if ends_here:
            y_end = by
        else:
            x_end = ax + (y_end - ay) * slope
            x_end = min(max(x_end, min(ax, bx)), max(ax, bx))
        light = (j0 + jy * row, jx, jy)
        rate = (g0 + gy * row, gx, gy)
        line = acc[row - first]
        y0, x0 = y, x
        if x0 < 0.0:  # the part left of the frame adds only to the sums for pixels further right
            y_in = y_end if x_end < 0.0 else y0 - x0 * rise
            _carry(line[0], y_in - y0, 0.5 * (y0 + y_in) - row, area, light, rate)
            x0, y0 = 0.0 if x_end >= 0.0 else width + 1.0, y_in
        elif x_end < width < x0:
            y0 += (width - x0) * rise
            x0 = float(width)
        column = math.floor(min(x0, width + 1.0))
        if not rightward and column == x0:
            column -= 1
        while 0 <= column < width:
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
            p, q, v0, v1 = x0 - column, x1 - column, y0 - row, y1 - row
            a, mx, my = piece(p, v0, q, v1)
            here, g_here = light[0] + jx * column, rate[0] + gx * column
            cell[0] += area * a
            cell[2] += here * a + jx * mx + jy * my
            local_rate = g_here * a + gx * mx + gy * my
            if moves:
                t0, t1 = (x0 - ax) * per_length, (x1 - ax) * per_length
                if steep:
                    t0, t1 = (y0 - ay) * per_length, (y1 - ay) * per_length
                l0, l1 = here + jx * p + jy * v0, here + jx * q + jy * v1
                local_rate -= flux(t1 - t0, l0, l1, qa + dq * t0, qa + dq * t1)
            cell[5] += local_rate
            _carry(cell, y1 - y0, 0.5 * (v0 + v1), area, light, rate)
            if done:
                break
            x0, y0 = x1, y1
            column += 1 if rightward else -1
        if x_end < 0.0 <= x0 <= width:  # the rest of an edge that leaves to the left
            _carry(line[0], y_end - y0, 0.5 * (y0 + y_end) - row, area, light, rate)
        if ends_here:
            break
        y, x = y_end, x_end
        row += 1


@lane
def add_facet(
    acc: Floats,
    f: int,
    shows: Ints,
    stamp: int,
    data: Data,
    rows: tuple[int, int, int],
) -> None:
    """Add the edges of a facet that shows; an edge between two such facets is added by the first of them."""
    vertices, faces, across, facets, over = data[0], data[1], data[2], data[4], data[6][f]
    k = facets[f, Sign]
    for side in range(3):
        g = across[f, side]
        shared = g >= 0 and shows[g] == stamp
        if shared and g < f:
            continue
        a, b = faces[f, side], faces[f, side + 1 if side < 2 else 0]
        ax, ay, bx, by = vertices[a, 0], vertices[a, 1], vertices[b, 0], vertices[b, 1]
        s = k
        area, j0, jx, jy = s, s * facets[f, L], s * facets[f, L + 1], s * facets[f, L + 2]
        g0, gx, gy = s * facets[f, G], s * facets[f, G + 1], s * facets[f, G + 2]
        if over >= 0:
            area = 0.0
            j0, jx, jy = j0 - s * facets[over, L], jx - s * facets[over, L + 1], jy - s * facets[over, L + 2]
            g0, gx, gy = g0 - s * facets[over, G], gx - s * facets[over, G + 1], gy - s * facets[over, G + 2]
        still = False
        if shared:
            o = facets[g, Sign]
            still = is_still(data, f, side)
            area -= o
            j0, jx, jy = j0 - o * facets[g, L], jx - o * facets[g, L + 1], jy - o * facets[g, L + 2]
            g0, gx, gy = g0 - o * facets[g, G], gx - o * facets[g, G + 1], gy - o * facets[g, G + 2]
        qa = qb = 0.0
        dx, dy = bx - ax, by - ay
        if not still:
            qa = vertices[a, 2] * dy - vertices[a, 3] * dx
            qb = vertices[b, 2] * dy - vertices[b, 3] * dx
        if dy == 0.0 and (dx == 0.0 or (qa == 0.0 and qb == 0.0)):
            continue
        if max(ay, by) < rows[0] or min(ay, by) >= rows[1] or min(ax, bx) >= rows[2]:
            continue
        if dy >= 0.0:
            _add_edge(acc, (ax, ay, bx, by), (qa, qb), (area, j0, jx, jy, g0, gx, gy), rows)
        else:  # the other way round all signs change; those of the flux twice
            _add_edge(acc, (bx, by, ax, ay), (-qb, -qa), (-area, -j0, -jx, -jy, -g0, -gx, -gy), rows)
