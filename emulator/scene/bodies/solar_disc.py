"""The Sun's disc behind straight edges: the share that is seen, and how far its middle shifts.

With a disc of radius 1 and everything below the line y = -x hidden, -1 <= x <= 1:

    share seen          1/2 + (x sqrt(1 - x^2) + asin x) / pi
    mean y of it        2/3 (1 - x^2)^(3/2) / (pi share)

The mean height of what is seen lifts the cosine of incidence: a surface that is turned away from the Sun's middle by
less than its radius still gets light, so the terminator has no kink.

The part of the disc inside a polygon is a sum over its edges (Green's theorem): triangles with the middle where the
edge is inside the disc, sectors where it is outside.
"""

from __future__ import annotations

import math

import numba

__all__ = ["edge_area", "seen_above"]


@numba.njit(error_model="numpy")
def seen_above(x: float) -> tuple[float, float]:
    """Return the share of the disc above the line y = -x, and the mean y of that part."""
    if x >= 1.0:
        return 1.0, 0.0
    if not x > -1.0:
        return 0.0, 0.0
    half = math.sqrt(1.0 - x * x)
    share = 0.5 + (x * half + math.asin(x)) / math.pi
    if share < 1e-9:  # a sliver: its mean is its rim
        return 0.0, 1.0
    return share, 2.0 / 3.0 * half * half * half / (math.pi * share)


@numba.njit(error_model="numpy")
def _sector(ax: float, ay: float, bx: float, by: float) -> float:
    return 0.5 * math.atan2(ax * by - ay * bx, ax * bx + ay * by)


@numba.njit(error_model="numpy")
def edge_area(ax: float, ay: float, bx: float, by: float) -> float:
    """Return the signed area between the middle of the unit disc and the edge from a to b, inside the disc."""
    dx, dy = bx - ax, by - ay
    length2 = dx * dx + dy * dy
    cross = ax * dy - ay * dx
    room = length2 - cross * cross  # above 0 where the line cuts the circle
    if not room > 0.0:
        return _sector(ax, ay, bx, by)
    root, along = math.sqrt(room), -(ax * dx + ay * dy)
    t0, t1 = (along - root) / length2, (along + root) / length2
    if t1 <= 0.0 or t0 >= 1.0:
        return _sector(ax, ay, bx, by)
    area = 0.0
    px, py, qx, qy = ax, ay, bx, by
    if t0 > 0.0:
        px, py = ax + t0 * dx, ay + t0 * dy
        area += _sector(ax, ay, px, py)
    if t1 < 1.0:
        qx, qy = ax + t1 * dx, ay + t1 * dy
        area += _sector(qx, qy, bx, by)
    return area + 0.5 * (px * qy - py * qx)
