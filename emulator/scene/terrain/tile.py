"""Memory of a tile of pixels: numbers of TILE pixels or corners side by side, all fields in one array.

Loops over a tile have a constant number of steps, and their fields constant distances, so that the compiler proves that
they do not overlap, and makes vectors. Numbers that need a search, as levels do, are found in loops of their own.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from emulator.sensor.numerics.compiled import inlined
from firmware_protocol.events import Float32s, Floats, Int32s

TILE = 64
"""Corners in a row of a tile; it has one pixel less."""

MOMENTS = 8
B, BP, BQ, BPP, BPQ, BQQ, P, Q = range(MOMENTS)
RATES = MOMENTS * TILE
"""Place of the moments' rates behind the moments."""


# Corners of a row: facets' planes.
CORNER_W, MIDDLE_W, W_ACROSS, W_DOWN, NORMAL_Z = range(5)
# Corners of a row: places relative to the camera, their change for lifting the facet by a metre, size.
X, Y, Z, LIFT_X, LIFT_Y, LIFT_Z, SIZE = range(5, 12)
# Corners of a row: the level's posts a metre, its first post, its last one.
PER_M, FIRST_X, FIRST_Y, LAST_X, LAST_Y = range(12, 17)
# The corners above: w and places. A pixel's loops read the corner right of it too, and so the first number of the next
# field, which they must not write: the compiler would make no vectors.
ABOVE_W, ABOVE_X, ABOVE_Y, ABOVE_Z = range(17, 21)
# Corners: posts from a post on, the four posts' heights, places between them.
POST_00, POST_01, POST_10, POST_11, WITHIN_X, WITHIN_Y, LIFTED = range(21, 28)
# Pixels: planes of the facets; footprints; boxes; direction to the eye; light.
OWN_W, OWN_ACROSS, OWN_DOWN = range(28, 31)
MIDDLE_X, MIDDLE_Y, SPREAD_X, SPREAD_XY, SPREAD_Y, LONGER, SHORTER, AXIS = range(31, 39)
TAPS, TAP_X, TAP_Y, HALF_X, HALF_Y, BOX_SIZE, DOUBT = range(39, 46)
EYE_X, EYE_Y, EYE_Z, FAST = range(46, 50)
# Boxes in posts of their level: middle of the first one, half sides, steps, weight of each; share of the next level.
BOX_U, BOX_V, HALF_U, HALF_V, STEP_U, STEP_V, WEIGHT, NEXT = range(50, 58)
# Pixels: rates of the footprint's middle on the ground and of the direction to the eye, a second; a short time; the
# rate of light.
MOVE_X, MOVE_Y, EYE_RATE_X, EYE_RATE_Y, EYE_RATE_Z, MOMENT_S, RATE = range(58, 65)
# Pixels: height of the footprint's middle, and its normal, both from the camera in the world.
MIDDLE_Z, ACROSS_X, ACROSS_Y, ACROSS_Z = range(65, 69)
FIELDS = 69

# Whole numbers: a level, its first post, posts in its rows, rows; a post; a pixel.
LEVEL, LEVEL_FIRST, LEVEL_COLUMNS, LEVEL_ROWS, POST, PIXEL = range(6)
PLACES = 6

# Inputs of the law of reflection, float64.
MU0, MU, CHORD2, SUNLIGHT, AROUND = range(5)
MEANS = 5


class Tile(NamedTuple):
    """Memory of a tile.

    Attributes
    ----------
    fields : (FIELDS + 1) TILE numbers; field f of pixel k is at f TILE + k.
    places : PLACES TILE whole numbers, in the same order.
    sums : moments of each pixel, and from RATES on their rates.
    inputs : (MEANS, TILE), of the law of reflection.
    """

    fields: Float32s
    places: Int32s
    sums: Float32s
    inputs: Floats


def new_tile() -> Tile:
    """Return room for a tile."""
    fields, places = np.zeros((FIELDS + 1) * TILE, np.float32), np.zeros(PLACES * TILE, np.int32)
    return Tile(fields, places, np.zeros(2 * RATES, np.float32), np.zeros((MEANS, TILE)))


@inlined
def triple(s: Float32s, field: int, k: int) -> tuple[float, float, float]:
    """Return three fields of pixel k that follow each other, as x, y and z do."""
    return s[field * TILE + k], s[(field + 1) * TILE + k], s[(field + 2) * TILE + k]


@inlined
def set_triple(s: Float32s, field: int, k: int, x: float, y: float, z: float) -> None:
    """Write three fields of pixel k that follow each other."""
    s[field * TILE + k] = x
    s[(field + 1) * TILE + k] = y
    s[(field + 2) * TILE + k] = z
