"""Vertices on the screen, and the planes of radiance, rate and inverse depth of each facet.

A facet's radiance is linear on the screen: L = c0 + cx x + cy y through its corners. At a fixed point it changes at the
rate G, linear too, with the corner values dL_i/dt - v_i . grad L, v_i the corner's velocity on the screen. 1 / depth is
linear on the screen exactly.

Facets that reach behind the camera are cut at the nearest depth. A cut facet becomes one or two facets with corners of
their own on the plane. Along its sides the new corners move with the material, which does not change the motion of
these sides across themselves. New facets have no neighbours: their sides are added to the sums one by one.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.raster.layout import (
    BAND,
    CULLED,
    FLAT,
    SHOWABLE,
    G,
    L,
    Sign,
    Valid,
    View,
    W,
    WHighest,
    WLowest,
    XHigh,
    XLow,
    YHigh,
    YLow,
    entry,
)
from emulator.raster.topology import Topology
from emulator.sensor.numerics.compiled import lane
from firmware_protocol.events import Bytes, Floats, Int32s

_THINNEST_PX = 1e-5  # a facet that is thinner has no gradient: rounding would be amplified beyond 1e-8 of its light
_FARTHEST_PX = 1e15  # far beyond any frame; keeps conversions to integers valid


@entry
def project(positions: Floats, velocities: Floats, camera: Floats, out: Floats) -> int:
    """Write vertices, (n, 8), and return the number nearer than the nearest depth; `camera` is (4,)."""
    focal, nearest = camera[0], camera[3]
    x0, y0 = camera[1], camera[2]
    lost = 0
    for k in range(len(positions)):
        z = positions[k, 2]
        if not z >= nearest:
            out[k, Valid] = 0.0
            lost += 1
            continue
        w = 1.0 / z
        x, y = positions[k, 0] * w, positions[k, 1] * w
        dz = velocities[k, 2]
        out[k, 0] = x0 + focal * x
        out[k, 1] = y0 + focal * y
        out[k, 2] = focal * w * (velocities[k, 0] - x * dz)
        out[k, 3] = focal * w * (velocities[k, 1] - y * dz)
        out[k, 4] = w
        out[k, 5] = -dz * w * w
        out[k, Valid] = 1.0
    return lost


class _Edges(NamedTuple):
    """A facet on the screen: its corner a, its edges a-b and a-c, and twice its area, below 0 seen from outside."""

    ax: float
    ay: float
    b_x: float
    b_y: float
    c_x: float
    c_y: float
    det: float


@lane
def _write_plane(facets: Floats, f: int, at: int, e: _Edges, a: float, b: float, c: float) -> tuple[float, float]:
    """Write the plane through values at the three corners; return its growth right and down."""
    d1, d2 = b - a, c - a
    px = (d1 * e.c_y - d2 * e.b_y) / e.det
    py = (d2 * e.b_x - d1 * e.c_x) / e.det
    facets[f, at] = a - px * e.ax - py * e.ay
    facets[f, at + 1] = px
    facets[f, at + 2] = py
    return px, py


@entry
def set_up(
    vertices: Floats, faces: Int32s, shades: Int32s, two_sided: Bytes, over: Int32s, radiance: Floats, rates: Floats,
    shape: tuple[int, int], facets: Floats, kinds: Bytes, spans: Int32s, touched: Int32s
) -> int:  # fmt: skip
    """Write facets (m, 16), kinds (m,), the bands of each (m, 2), and the touched rows and columns (4,).

    Return the entries in all bands' lists. `spans` are the first band and the one after the last; equal where the facet
    is skipped.
    """
    height, width = shape
    touched[0], touched[1], touched[2], touched[3] = height, 0, width, 0
    entries = 0
    for f in range(len(faces)):
        kinds[f] = CULLED
        spans[f, 0] = spans[f, 1] = 0
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        ax, ay = vertices[a, 0], vertices[a, 1]
        bx, by = vertices[b, 0], vertices[b, 1]
        cx, cy = vertices[c, 0], vertices[c, 1]
        e1x, e1y = bx - ax, by - ay
        e2x, e2y = cx - ax, cy - ay
        det = e1x * e2y - e1y * e2x
        # Skipped are facets seen from behind, on a skipped facet, with a corner too near, or beside the frame.
        if not (det < 0.0 or (det > 0.0 and two_sided[f])):
            continue
        if over[f] >= 0 and kinds[over[f]] == CULLED:  # a patch comes after its facet
            continue
        if vertices[a, Valid] + vertices[b, Valid] + vertices[c, Valid] < 3.0:
            continue
        x_low, x_high = min(ax, bx, cx), max(ax, bx, cx)
        y_low, y_high = min(ay, by, cy), max(ay, by, cy)
        if not (x_high > -1.0 and x_low < width + 1.0 and y_high > -1.0 and y_low < height + 1.0):
            continue
        if not (x_high - x_low < _FARTHEST_PX and y_high - y_low < _FARTHEST_PX):
            continue
        # Values at the corners: 1 / depth, radiance, and its rate for the material.
        wa, wb, wc = vertices[a, 4], vertices[b, 4], vertices[c, 4]
        i, j, k = shades[f, 0], shades[f, 1], shades[f, 2]
        la, lb, lc = radiance[i], radiance[j], radiance[k]
        ga, gb, gc = rates[i], rates[j], rates[k]
        facets[f, WLowest], facets[f, WHighest] = min(wa, wb, wc), max(wa, wb, wc)
        facets[f, XLow], facets[f, XHigh] = x_low, x_high
        facets[f, YLow], facets[f, YHigh] = y_low, y_high
        facets[f, Sign] = 1.0 if det < 0.0 else -1.0
        e3x, e3y = cx - bx, cy - by
        longest2 = max(e1x * e1x + e1y * e1y, e2x * e2x + e2y * e2y, e3x * e3x + e3y * e3y)
        if det * det > _THINNEST_PX * _THINNEST_PX * longest2:
            kinds[f] = SHOWABLE
            edges = _Edges(ax, ay, e1x, e1y, e2x, e2y, det)
            px, py = _write_plane(facets, f, L, edges, la, lb, lc)
            # At a fixed point the material that moves in has other radiance.
            ga = ga - px * vertices[a, 2] - py * vertices[a, 3]
            gb = gb - px * vertices[b, 2] - py * vertices[b, 3]
            gc = gc - px * vertices[c, 2] - py * vertices[c, 3]
            _write_plane(facets, f, G, edges, ga, gb, gc)
            _write_plane(facets, f, W, edges, wa, wb, wc)
        else:
            kinds[f] = FLAT
            for at in range(9):
                facets[f, at] = 0.0
            facets[f, L] = (la + lb + lc) / 3
            facets[f, G] = (ga + gb + gc) / 3
            facets[f, W] = (wa + wb + wc) / 3
        # The bands whose rows, and one more on each side, it may touch.
        spans[f, 0] = int(max(y_low - 1.0, 0.0)) // BAND
        spans[f, 1] = int(min(max(y_high + 1.0, 0.0), height - 1.0)) // BAND + 1
        entries += spans[f, 1] - spans[f, 0]
        if x_high > 0.0 and x_low < width and y_high > 0.0 and y_low < height:
            touched[0] = min(touched[0], int(max(y_low, 0.0)))
            touched[1] = max(touched[1], int(min(y_high, height - 1.0)) + 1)
            touched[2] = min(touched[2], int(max(x_low, 0.0)))
            touched[3] = max(touched[3], int(min(x_high, width - 1.0)) + 1)
    return entries


@entry
def bucket(spans: Int32s, starts: Int32s, listed: Int32s) -> None:
    """Write the facets of each band, by the `spans` of `set_up`.

    Those of band b are listed[starts[b]:starts[b + 1]], in ascending order.
    """
    # Counts two places ahead become beginnings one place ahead, which move to the ends as facets are listed.
    starts[:] = 0
    for f in range(len(spans)):
        for b in range(spans[f, 0], spans[f, 1]):
            starts[b + 2] += 1
    for b in range(2, len(starts)):
        starts[b] += starts[b - 1]
    for f in range(len(spans)):
        for b in range(spans[f, 0], spans[f, 1]):
            listed[starts[b + 1]] = f
            starts[b + 1] += 1


def clip(topology: Topology, view: View, nearest_m: float) -> tuple[Topology, View]:
    """Return topology and view with the visible parts of facets that `nearest_m` cuts at the end."""
    ahead = view.positions_m[: topology.vertices, 2] >= nearest_m
    inside = ahead[topology.faces]
    count = inside.sum(axis=1)
    with_one, with_two = np.flatnonzero(count == 1), np.flatnonzero(count == 2)  # facets by their corners ahead
    if not len(with_one) and not len(with_two):
        return topology, view
    turn_one, turn_two = inside[with_one].argmax(axis=1), ((~inside[with_two]).argmax(axis=1) + 1) % 3
    vertices = _Corners(topology.vertices, np.hstack([view.positions_m, view.velocities_m_s]))
    entries = _Corners(topology.entries, np.column_stack([view.radiance, view.radiance_rate]))
    depth = view.positions_m[:, 2]
    faces: list[list[Int32s]] = []
    shades: list[list[Int32s]] = []
    for table, corners, out in ((topology.faces, vertices, faces), (topology.shades, entries, shades)):
        a, b, c = _turned(table[with_one], turn_one)
        za, zb, zc = (depth[k] for k in _turned(topology.faces[with_one], turn_one))
        out.append([a, corners.cut(a, b, za, zb, nearest_m), corners.cut(a, c, za, zc, nearest_m)])
        a, b, c = _turned(table[with_two], turn_two)
        za, zb, zc = (depth[k] for k in _turned(topology.faces[with_two], turn_two))
        behind_b, behind_a = corners.cut(b, c, zb, zc, nearest_m), corners.cut(a, c, za, zc, nearest_m)
        out.extend([[a, b, behind_b], [a, behind_b, behind_a]])
    added = np.concatenate([with_one, with_two, with_two])
    over = np.where(np.isin(topology.over, added), np.int32(-1), topology.over)  # a patch on a cut facet is one itself
    places = vertices.values
    places[topology.vertices :, 2] = nearest_m  # exact, without rounding
    extended = Topology(
        _longer(topology.faces, faces),
        _longer(topology.shades, shades),
        np.concatenate([topology.across, np.full((len(added), 3), -1, np.int32)]),
        np.concatenate([topology.smooth, np.zeros((len(added), 3), np.uint8)]),
        np.concatenate([topology.two_sided, topology.two_sided[added]]),
        len(places),
        len(entries.values),
        np.concatenate([over, np.full(len(added), -1, np.int32)]),
    )
    return extended, View(places[:, :3], places[:, 3:], entries.values[:, 0], entries.values[:, 1])


class _Corners:
    """Values of corners, those of cuts behind the given ones."""

    def __init__(self, count: int, values: Floats) -> None:
        self.values = values[:count]

    def cut(self, a: Int32s, b: Int32s, z_a: Floats, z_b: Floats, depth_m: float) -> Int32s:
        """Append values where the line from corner a to corner b crosses `depth_m`; return their numbers."""
        share = ((depth_m - z_a) / (z_b - z_a))[:, None]
        first = len(self.values)
        self.values = np.concatenate([self.values, self.values[a] * (1 - share) + self.values[b] * share])
        return np.arange(first, len(self.values), dtype=np.int32)


def _turned(corners: Int32s, first: npt.NDArray[np.intp]) -> tuple[Int32s, Int32s, Int32s]:
    """Return the corners, (n,) each, that of the given place first."""
    rows = np.arange(len(corners))
    return corners[rows, first], corners[rows, (first + 1) % 3], corners[rows, (first + 2) % 3]


def _longer(table: Int32s, added: list[list[Int32s]]) -> Int32s:
    return np.concatenate([table, *(np.column_stack(corners).astype(np.int32) for corners in added)])
