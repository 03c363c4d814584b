"""Columns of the arrays that kernels share.

A vertex (n, 8) float64: screen place and velocity in px and px/s, w = 1 / depth in 1/m and its rate in 1/m/s, validity.
A facet (m, 16) float64: planes p(x, y) = p0 + px x + py y of radiance L, of its rate at a fixed point G and of w; the
range of w and of the screen box; and the sign of its winding, +1 seen from outside, -1 seen from inside.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = [
    "BAND",
    "CULLED",
    "FACET_FIELDS",
    "FLAT",
    "SHOWABLE",
    "VERTEX_FIELDS",
    "Bytes",
    "Data",
    "Floats",
    "G",
    "Ints",
    "L",
    "Pictures",
    "Plane",
    "Sides",
    "Sign",
    "Valid",
    "W",
    "WHighest",
    "WLowest",
    "XHigh",
    "XLow",
    "YHigh",
    "YLow",
]

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int32]
Bytes = npt.NDArray[np.uint8]
Pictures = npt.NDArray[np.float32]

Data = tuple[Any, ...]
"""What kernels pass on: vertices, faces, across, smooth, facets, kinds, over."""

Plane = tuple[float, float, float]
Sides = tuple[float, float, float, float, float]

BAND = 16
"""Rows of a band: its accumulators stay in the second-level cache."""

VERTEX_FIELDS, FACET_FIELDS = 8, 16
Valid = 6  # a vertex's x, y, vx, vy, w, dw/dt are 0 to 5
L, G, W = 0, 3, 6
WLowest, WHighest, XLow, XHigh, YLow, YHigh, Sign = 9, 10, 11, 12, 13, 14, 15

CULLED, SHOWABLE, FLAT = 0, 1, 2
"""Kinds of facets: left out; drawn; drawn with constant radiance because it is too thin for a gradient."""
