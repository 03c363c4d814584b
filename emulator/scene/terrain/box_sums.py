"""Sums of the map's posts over the squares around a pixel's parts, and their reflectance, in the processor's vectors.

numba turns loops into vectors where it can prove that arrays do not overlap, tests this at run time otherwise, and puts
results in memory between loops. A square has few posts, and a pixel few parts: these tests and stores take longer than
the sums. So this one function is written with the compiler's own vectors: it processes four parts at a time, and of
each part's posts those of a row side by side. It writes nothing to memory in between, so threads share no cache lines.
"""

from __future__ import annotations

from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj

from emulator.scene.terrain.block_vertices import GRAZING
from emulator.scene.terrain.compiled_vectors import (
    FUSED,
    INT,
    at_least,
    constant,
    integers,
    lane,
    load,
    magnitude,
    numbers,
    picked,
    product_sum,
    root,
    spread,
    within,
)
from emulator.scene.terrain.ground import FIELDS

__all__ = ["POSTS", "box_sums"]

_types: Any = numba.types  # numba's functions here have no types that mypy could read
_code: Any = cgutils
_make_array: Any = arrayobj.make_array
_intrinsic: Any = intrinsic

POSTS = 6
"""Along each side of a square; its side is at most POSTS - 2 posts long."""

_NUMBERS, _WHOLE = 26, 5

_PARTS = 4  # at a time
_LANES = 8
_VECTORS = POSTS * FIELDS // _LANES  # of a row
_TINY = 1e-30
_SLOPES = 0.5, 2.0  # least and most of a secant


@_intrinsic
def box_sums(context: Any, posts: Any, scalars: Any, whole: Any) -> Any:
    """Return the sums of b p, b q, b and b / (mu0 + mu) over the squares around all parts, times (2 half)^2.

    mu0 and mu are of the mean slope of each square.

    Parameters
    ----------
    posts : (4 n,) float32: height, b p, b q, b of each; see `Pyramid`.
    scalars : the pixel's middle x, y in posts and z in metres; their change for a pixel to the right, and for one down;
        their change for lifting the facet by a metre; parts across, 1 / parts across, 1 / parts down; half a square's
        side in posts; the last x and y at which heights are read, and those of squares' middles; unit vectors towards
        the Sun and the eye.
    whole : place in `posts` of the level's first number, numbers from one row to the next, columns, rows, parts.
    """
    return _types.UniTuple(_types.float64, 4)(
        posts, _types.UniTuple(_types.float32, _NUMBERS), _types.UniTuple(_types.int64, _WHOLE)
    ), _generate


def _generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
    array, scalars, whole = arguments
    data = _make_array(signature.args[0])(context, builder, array).data
    scalars, whole = _code.unpack_tuple(builder, scalars), _code.unpack_tuple(builder, whole)
    count = whole[4]
    none = constant([0.0] * _PARTS)
    totals = [_code.alloca_once_value(builder, none) for _ in range(FIELDS)]
    squares = [_code.alloca_once_value(builder, none) for _ in range(_PARTS)]
    with _code.for_range_slice(builder, INT(0), count, INT(_PARTS), INT.type) as (k, _):
        columns, rows, across, down = _squares(builder, data, scalars, whole, k)
        for part, square in enumerate(squares):
            builder.store(none, square)
            with builder.if_then(builder.icmp_signed("<", builder.add(k, INT(part)), count), likely=True):
                column, row, x, y = (lane(builder, v, part) for v in (columns, rows, across, down))
                sums = _square(builder, data, _place(builder, whole, column, row), whole[1], (x, y, scalars[15]))
                builder.store(sums, square)
        bp, bq, b = _by_field(builder, [builder.load(square) for square in squares])
        for total, more in zip(totals, (bp, bq, b, _reflected(builder, scalars, bp, bq, b)), strict=True):
            builder.store(builder.fadd(builder.load(total), more), total)
    return _code.pack_array(builder, [_sum(builder, builder.load(total)) for total in totals])


def _by_field(builder: ir.IRBuilder, squares: list[Any]) -> tuple[Any, Any, Any]:
    """Return b p, b q and b of four parts from each part's four numbers."""
    first, last = (_mixed(builder, squares[k], squares[k + 1], [1, 5, 2, 6]) for k in (0, 2))
    bp, bq = (_mixed(builder, first, last, [k, k + 1, k + 4, k + 5]) for k in (0, 2))
    first, last = (_mixed(builder, squares[k], squares[k + 1], [3, 7, 3, 7]) for k in (0, 2))
    return bp, bq, _mixed(builder, first, last, [0, 1, 4, 5])


def _reflected(builder: ir.IRBuilder, scalars: Any, bp: Any, bq: Any, b: Any) -> Any:
    """Return b / (mu0 + mu) of four parts: b |n| / (n . sun + n . eye), n = (-b p, -b q, b)."""
    none = constant([0.0] * _PARTS)
    b = at_least(builder, b, none)
    length = root(builder, product_sum(builder, bp, bp, product_sum(builder, bq, bq, builder.fmul(b, b))))
    cosines = []
    for k in (20, 23):
        x, y, z = (spread(builder, number, _PARTS) for number in scalars[k : k + 3])
        level = builder.fmul(b, z)
        cosines.append(builder.fsub(builder.fsub(level, builder.fmul(bp, x)), builder.fmul(bq, y)))
    seen = at_least(builder, cosines[1], builder.fmul(length, constant([GRAZING] * _PARTS)))
    both = builder.fadd(at_least(builder, cosines[0], none), seen)
    return builder.fdiv(builder.fmul(b, length), at_least(builder, both, constant([_TINY] * _PARTS)))


def _mixed(builder: ir.IRBuilder, a: Any, b: Any, lanes: list[int]) -> Any:
    """Return some numbers of two vectors."""
    return builder.shuffle_vector(a, b, ir.Constant(ir.VectorType(ir.IntType(32), len(lanes)), lanes))


def _sum(builder: ir.IRBuilder, vector: Any) -> Any:
    """Return the sum of a vector's numbers in double precision."""
    lanes = [builder.fpext(lane(builder, vector, k), ir.DoubleType()) for k in range(vector.type.count)]
    return builder.fadd(builder.fadd(lanes[0], lanes[1]), builder.fadd(lanes[2], lanes[3]))


def _squares(builder: ir.IRBuilder, data: Any, scalars: Any, whole: Any, k: Any) -> tuple[Any, Any, Any, Any]:
    """Return column and row of the first post of four parts' squares, and their middles from there, in posts."""
    f = [spread(builder, number, _PARTS) for number in scalars]
    first = builder.sitofp(k, ir.FloatType())
    kth = builder.fadd(spread(builder, first, _PARTS), constant([n + 0.5 for n in range(_PARTS)]))
    line = numbers(builder, integers(builder, builder.fmul(kth, f[13])))
    half_way = constant([0.5] * _PARTS)
    right = builder.fsub(builder.fmul(builder.fsub(kth, builder.fmul(line, f[12])), f[13]), half_way)
    below = builder.fsub(builder.fmul(builder.fadd(line, half_way), f[14]), half_way)
    x, y, z = (product_sum(builder, below, f[6 + n], product_sum(builder, right, f[3 + n], f[n])) for n in range(3))
    lifted = _above(builder, data, whole, (x, y, z), f)
    ends = []
    for n, at in ((0, x), (1, y)):
        moved = within(builder, product_sum(builder, lifted, f[9 + n], at), f[15], f[18 + n])
        last = spread(builder, builder.trunc(builder.sub(whole[2 + n], INT(POSTS)), ir.IntType(32)), _PARTS)
        post = integers(builder, builder.fsub(moved, f[15]))
        post = builder.select(builder.icmp_signed("<", post, last), post, last)
        none = ir.Constant(post.type, [0] * _PARTS)
        post = builder.select(builder.icmp_signed(">", post, none), post, none)
        ends.append((post, builder.fsub(moved, numbers(builder, post))))
    return ends[0][0], ends[1][0], ends[0][1], ends[1][1]


def _above(builder: ir.IRBuilder, data: Any, whole: Any, at: tuple[Any, Any, Any], f: list[Any]) -> Any:
    """Return the height by which the plane must be lifted for four rays to meet it on the ground, metres.

    The height above the plane where a ray meets the plane is the first guess. Where the ray then meets the lifted plane
    the ground is higher or lower by `more`; a secant through both is the second guess, its slope within bounds, as the
    ray may meet other ground in between.
    """
    x, y, z = at
    last = f[16], f[17]
    lifted = builder.fsub(_height(builder, data, whole, x, y, last), z)
    x, y, z = (product_sum(builder, lifted, f[9 + n], at[n]) for n in range(3))
    more = builder.fsub(_height(builder, data, whole, x, y, last), z)
    slope = builder.fdiv(lifted, builder.fsub(lifted, more))
    slope = within(builder, slope, *(constant([bound] * _PARTS) for bound in _SLOPES))
    return product_sum(builder, more, slope, lifted)


def _height(builder: ir.IRBuilder, data: Any, whole: Any, x: Any, y: Any, most: tuple[Any, Any]) -> Any:
    """Return the map's heights at four places, linear between posts."""
    none = constant([0.0] * _PARTS)
    x, y = within(builder, x, none, most[0]), within(builder, y, none, most[1])
    column, row = integers(builder, x), integers(builder, y)
    u, v = builder.fsub(x, numbers(builder, column)), builder.fsub(y, numbers(builder, row))
    lows = [_place(builder, whole, lane(builder, column, k), lane(builder, row, k)) for k in range(_PARTS)]
    edges = []
    for places in (lows, [builder.add(low, whole[1]) for low in lows]):
        left = picked(builder, data, places)
        right = picked(builder, data, [builder.add(place, INT(FIELDS)) for place in places])
        edges.append(product_sum(builder, builder.fsub(right, left), u, left))
    return product_sum(builder, builder.fsub(edges[1], edges[0]), v, edges[0])


def _place(builder: ir.IRBuilder, whole: Any, column: Any, row: Any) -> Any:
    """Return the place of a post's first number."""
    column, row = (builder.zext(n, INT.type) for n in (column, row))
    return builder.add(builder.add(whole[0], builder.mul(row, whole[1])), builder.mul(column, INT(FIELDS)))


def _square(builder: ir.IRBuilder, data: Any, place: Any, wide: Any, at: tuple[Any, Any, Any]) -> Any:
    """Return the sums over a square of POSTS x POSTS posts, FIELDS numbers."""
    x, y, half = at
    across, down = _weights(builder, x, half), _weights(builder, y, half)
    sums: list[Any] = [constant([0.0] * _LANES)] * _VECTORS
    for row in range(POSTS):
        weight = spread(builder, lane(builder, down, row), _LANES)
        for k in range(_VECTORS):
            some = load(builder, data, builder.add(place, INT(k * _LANES)), _LANES)
            sums[k] = (
                builder.fmul(some, weight, flags=FUSED) if row == 0 else product_sum(builder, some, weight, sums[k])
            )
        place = builder.add(place, wide)
    total = constant([0.0] * _LANES)
    for k, column in enumerate(sums):
        chosen = ir.Constant(ir.VectorType(ir.IntType(32), _LANES), [(k * _LANES + n) // FIELDS for n in range(_LANES)])
        total = product_sum(builder, column, builder.shuffle_vector(across, across, chosen), total)
    low, high = (_mixed(builder, total, total, list(range(k, k + FIELDS))) for k in (0, FIELDS))
    return builder.fadd(low, high)


def _weights(builder: ir.IRBuilder, middle: Any, half: Any) -> Any:
    """Return the weights of posts 0, 1 ... in the mean within `half` of the middle, times 2 half."""
    posts, one, less = constant([float(k) for k in range(_LANES)]), constant([1.0] * _LANES), constant([-1.0] * _LANES)
    ends = []
    for end in (builder.fsub(middle, half), builder.fadd(middle, half)):
        u = within(builder, builder.fsub(spread(builder, end, _LANES), posts), less, one)
        ends.append(product_sum(builder, builder.fmul(u, constant([-0.5] * _LANES)), magnitude(builder, u), u))
    return builder.fsub(ends[1], ends[0])
