"""Sums of the ground's moments over boxes of posts, in the processor's vectors.

numba turns loops into vectors where it can prove that arrays do not overlap, tests this at run time otherwise, and puts
results in memory between loops. A box has few posts: these tests and stores take longer than the sums. So this one
function is written with the compiler's own vectors: the eight moments of a post are one vector.

The mean over a box of a function that is linear between posts is exact: a post at t posts from the box's middle has the
weight (I(r - t) - I(-r - t)) / 2 r along each axis, r half its side and I the integral of the hat function. Weights of
half a side of at most MOST_POSTS / 2 - 1 posts are sums over at most MOST_POSTS posts. Code for few posts, which most
boxes have, and for many is unrolled. Vectors of any length are correct on any processor: the compiler splits them where
the processor's are shorter.

Where the box moves by v posts a second, these weights have the rates (hat(r - t) - hat(-r - t)) v / 2 r along each
axis, hat(t) = I'(t). The rates of the means take one more product a post, of numbers that are at hand.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numba
from llvmlite import ir
from numba.core import cgutils
from numba.extending import intrinsic
from numba.np import arrayobj

from emulator.scene.terrain.tile import MOMENTS, RATES

_types: Any = numba.types  # numba's functions here have no types that mypy could read
_code: Any = cgutils
_make_array: Any = arrayobj.make_array
_intrinsic: Any = intrinsic

MOST_POSTS = 6
"""Along each side of a box; its side is at most MOST_POSTS - 2 posts long."""

_FEW = 4  # posts along each side of most boxes
_ROWS = 2  # at a time
_LANES = 8  # of weights
_HALF, _FLOAT, _INT, _INT32 = ir.HalfType(), ir.FloatType(), ir.IntType(64), ir.IntType(32)
_FUSED = ("contract",)  # flag of a product and a sum that may have one rounding, where the processor has such a step


def _int(number: int) -> ir.Constant:
    """Return a whole number."""
    return ir.Constant(_INT, number)


def _constant(lanes: Sequence[float]) -> ir.Constant:
    """Return a vector of these numbers."""
    return ir.Constant(ir.VectorType(_FLOAT, len(lanes)), list(lanes))


def _spread(builder: ir.IRBuilder, number: Any, lanes: int) -> Any:
    """Return a vector whose lanes all hold `number`."""
    none = ir.Constant(ir.VectorType(number.type, lanes), ir.Undefined)
    first = builder.insert_element(none, number, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(first, none, ir.Constant(ir.VectorType(_INT32, lanes), [0] * lanes))


def _product_sum(builder: ir.IRBuilder, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c."""
    return builder.fadd(builder.fmul(a, b, flags=_FUSED), c, flags=_FUSED)


@_intrinsic
def add_box(context: Any, moments: Any, level: Any, box: Any, sums: Any, at: Any) -> Any:
    """Add the mean of the moments over a box, times `weight` and both half sides, to MOMENTS `sums` from `at` on.

    The rate of what it adds is added from `at` + RATES on.

    Parameters
    ----------
    moments : (MOMENTS n,) uint16, 16-bit floats; see `Pyramid`.
    level : number of the level's first post, posts in a row, and rows: the last post's place follows.
    box : middle x and y in posts of the level, half sides, weight, posts that it moves a second, x and y; the box is
        within the level.
    sums : (n,) float32.
    """

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        first, out = (_make_array(signature.args[k])(context, builder, arguments[k]).data for k in (0, 3))
        _add(builder, first, arguments[1:3], builder.gep(out, [arguments[4]]))
        return context.get_dummy_value()

    long, real = _types.int64, _types.float32
    return _types.void(moments, _types.UniTuple(long, 3), _types.UniTuple(real, 7), sums, long), generate


@_intrinsic
def from_half(context: Any, number: Any) -> Any:
    """Return the number of a 16-bit float, given as uint16."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        return builder.fpext(builder.bitcast(arguments[0], _HALF), _FLOAT)

    return _types.float32(_types.uint16), generate


@_intrinsic
def to_half(context: Any, number: Any) -> Any:
    """Return the 16-bit float nearest to a float32 number, as uint16."""

    def generate(context: Any, builder: ir.IRBuilder, signature: Any, arguments: Any) -> Any:
        return builder.bitcast(builder.fptrunc(arguments[0], _HALF), ir.IntType(16))

    return _types.uint16(_types.float32), generate


def _add(builder: ir.IRBuilder, data: Any, place_of: Any, out: Any) -> None:
    """Add the mean over a box to numbers from `out` on, and its rate."""
    first, columns, rows = _code.unpack_tuple(builder, place_of[0])
    x, y, half_x, half_y, weight, move_x, move_y = _code.unpack_tuple(builder, place_of[1])
    left, across, wide = _side(builder, x, half_x, columns, move_x)
    top, down, high = _side(builder, y, half_y, rows, move_y)
    place = builder.add(first, builder.add(builder.mul(top, columns), left))
    totals = [_code.alloca_once_value(builder, _constant([0.0] * MOMENTS)) for _ in across]
    weights = [builder.bitcast(_code.alloca_once_value(builder, shares), _FLOAT.as_pointer()) for shares in down]
    end, small, large = (builder.append_basic_block(name) for name in ("end", "small", "large"))
    is_small = builder.and_(*(builder.icmp_signed("<=", count, _int(_FEW)) for count in (wide, high)))
    builder.cbranch(is_small, small, large)
    for n, lines, case in ((_FEW, _int(_FEW), small), (MOST_POSTS, high, large)):
        builder.position_at_end(case)
        spreads = [
            [_spread(builder, builder.extract_element(shares, ir.Constant(_INT32, k)), MOMENTS) for k in range(n)]
            for shares in across
        ]
        with _code.for_range_slice(builder, _int(0), lines, _int(_ROWS), _INT) as (first_row, _):
            sums = [builder.load(total) for total in totals]
            for further in range(_ROWS):
                index = builder.add(first_row, _int(further))
                row = _row(builder, data, builder.add(place, builder.mul(index, columns)), spreads)
                share, rate = (_spread(builder, builder.load(builder.gep(w, [index])), MOMENTS) for w in weights)
                # The mean's sum, and its rate: of the row's rate by the share, and of the row by the share's rate.
                sums = [_product_sum(builder, values, share, sum_) for values, sum_ in zip(row, sums, strict=True)]
                sums[1] = _product_sum(builder, row[0], rate, sums[1])
            for sum_, total in zip(sums, totals, strict=True):
                builder.store(sum_, total)
        builder.branch(end)
    builder.position_at_end(end)
    share = _spread(builder, builder.fmul(weight, ir.Constant(_FLOAT, 0.25)), MOMENTS)
    for k, total in enumerate(totals):
        to = builder.bitcast(builder.gep(out, [_int(k * RATES)]), ir.VectorType(_FLOAT, MOMENTS).as_pointer())
        builder.store(_product_sum(builder, builder.load(total), share, builder.load(to, align=4)), to, align=4)


def _side(builder: ir.IRBuilder, middle: Any, half: Any, posts: Any, move: Any) -> tuple[Any, list[Any], Any]:
    """Return the first post, weights of the posts from there, and how many have one; the weights' rates too."""
    low, high = builder.fsub(middle, half), builder.fadd(middle, half)
    last = builder.sub(posts, _int(MOST_POSTS))
    begin = builder.fptosi(low, _INT)
    begin = builder.select(builder.icmp_signed("<", begin, last), begin, last)
    begin = builder.select(builder.icmp_signed(">", begin, _int(0)), begin, _int(0))
    count = builder.add(builder.sub(builder.fptosi(high, _INT), begin), _int(2))
    for bound, sign in ((_int(MOST_POSTS), "<"), (_int(_FEW), ">")):
        count = builder.select(builder.icmp_signed(sign, count, bound), count, bound)
    offset = builder.sitofp(begin, _FLOAT)
    return begin, _weights(builder, builder.fsub(low, offset), builder.fsub(high, offset), move), count


def _weights(builder: ir.IRBuilder, low: Any, high: Any, move: Any) -> list[Any]:
    """Return the integrals of the hat functions of posts 0, 1 ... from `low` to `high`, times 2, and their rates."""
    posts = _constant([float(k) for k in range(_LANES)])
    plus_1, minus_1 = _constant([1.0] * _LANES), _constant([-1.0] * _LANES)
    ends, heights = [], []
    kind = ir.FunctionType(posts.type, [posts.type])
    magnitude = _code.get_or_insert_function(builder.module, kind, f"llvm.fabs.v{_LANES}f32")
    for end in (low, high):
        # Within -1 to 1; -1 for NaN.
        away = builder.fsub(_spread(builder, end, _LANES), posts)
        lowered = builder.select(builder.fcmp_ordered("<", away, plus_1), away, plus_1)
        u = builder.select(builder.fcmp_ordered(">", lowered, minus_1), lowered, minus_1)
        heights.append(builder.call(magnitude, [u]))
        ends.append(_product_sum(builder, builder.fmul(u, _constant([-0.5] * _LANES)), heights[-1], u))
    return [builder.fsub(ends[1], ends[0]), builder.fmul(builder.fsub(*heights), _spread(builder, move, _LANES))]


def _row(builder: ir.IRBuilder, data: Any, start: Any, weights: list[list[Any]]) -> list[Any]:
    """Return the sums of the moments of posts from `start` on, by each list of weights."""
    totals: list[Any] = []
    kind = ir.VectorType(_HALF, MOMENTS).as_pointer()
    for k in range(len(weights[0])):
        place = builder.mul(builder.add(start, _int(k)), _int(MOMENTS))
        halves = builder.load(builder.bitcast(builder.gep(data, [place]), kind), align=2)
        moments = builder.fpext(halves, ir.VectorType(_FLOAT, MOMENTS))
        if not k:
            totals = [builder.fmul(moments, shares[0]) for shares in weights]
        else:
            pairs = zip(weights, totals, strict=True)
            totals = [_product_sum(builder, moments, shares[k], total) for shares, total in pairs]
    return totals
