"""Decorators of the light of bodies, and vectors in its kernels.

Kernels and most entries count no references and so cannot allocate: with it shadow polygons took nearly twice as long.
"""

from __future__ import annotations

from emulator.sensor.numerics.compiled import inlined
from firmware_protocol.compiled import entry_of, kernel
from firmware_protocol.events import Floats, Int32s

__all__ = ["ZERO", "Point", "cross", "dot", "entry", "kernel", "minus", "plus", "row", "vertex"]

_SOURCES = "emulator.scene.bodies", "emulator.photometry", "emulator.raster.layout", "emulator.sensor.numerics.compiled"

entry = entry_of(*_SOURCES, _nrt=False)
"""Compile a function for calls from Python; it releases the GIL."""

Numbers = Int32s
Point = tuple[float, float, float]
"""A place, m, or a direction."""
ZERO: Point = (0.0, 0.0, 0.0)


@inlined
def row(points: Floats, k: int) -> Point:
    """Return row k of an array, (n, 3)."""
    return points[k, 0], points[k, 1], points[k, 2]


@kernel
def vertex(triangle: Floats, k: int) -> Point:
    """Return corner k of a triangle, (9,)."""
    return triangle[3 * k], triangle[3 * k + 1], triangle[3 * k + 2]


@kernel
def minus(a: Point, b: Point) -> Point:
    """Return the vector from b to a."""
    return a[0] - b[0], a[1] - b[1], a[2] - b[2]


@kernel
def plus(a: Point, scale: float, b: Point) -> Point:
    """Return a + scale b."""
    return a[0] + scale * b[0], a[1] + scale * b[1], a[2] + scale * b[2]


@kernel
def dot(a: Point, b: Point) -> float:
    """Return the inner product."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@kernel
def cross(a: Point, b: Point) -> Point:
    """Return the vector product."""
    return a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]
