"""Arithmetic on the compiler's vectors: the few operations that `box_moments` uses.

Each takes the builder of the code, and values in it. Vectors of any length are correct on any processor: the compiler
splits them where the processor's are shorter.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from llvmlite import ir
from numba.core import cgutils

FUSED = ("contract",)
"""Flag of a product and a sum that may have one rounding, where the processor has such an operation."""

_code: Any = cgutils  # its functions have no types that mypy could read

_INT, _INT32, _FLOAT = ir.IntType(64), ir.IntType(32), ir.FloatType()


class _Int:
    """Makes whole numbers of 64 bits."""

    type = _INT

    def __call__(self, number: int) -> ir.Constant:
        return ir.Constant(_INT, number)


INT = _Int()


def constant(lanes: Sequence[float]) -> ir.Constant:
    """Return a vector of these numbers."""
    return ir.Constant(ir.VectorType(_FLOAT, len(lanes)), list(lanes))


def spread(builder: ir.IRBuilder, number: Any, lanes: int) -> Any:
    """Return a vector whose lanes all hold `number`."""
    none = ir.Constant(ir.VectorType(number.type, lanes), ir.Undefined)
    one = builder.insert_element(none, number, ir.Constant(_INT32, 0))
    return builder.shuffle_vector(one, none, ir.Constant(ir.VectorType(_INT32, lanes), [0] * lanes))


def lane(builder: ir.IRBuilder, vector: Any, k: int) -> Any:
    """Return one number of a vector."""
    return builder.extract_element(vector, ir.Constant(_INT32, k))


def product_sum(builder: ir.IRBuilder, a: Any, b: Any, c: Any) -> Any:
    """Return a b + c."""
    return builder.fadd(builder.fmul(a, b, flags=FUSED), c, flags=FUSED)


def within(builder: ir.IRBuilder, vector: Any, low: Any, high: Any) -> Any:
    """Return the numbers, none beyond the bounds; `low` where bounds cross or a number is NaN."""
    less = builder.select(builder.fcmp_ordered("<", vector, high), vector, high)
    return builder.select(builder.fcmp_ordered(">", less, low), less, low)


def magnitude(builder: ir.IRBuilder, vector: Any) -> Any:
    """Return the numbers without their signs."""
    return _of_each(builder, "fabs", vector)


def _of_each(builder: ir.IRBuilder, name: str, vector: Any) -> Any:
    kind = ir.FunctionType(vector.type, [vector.type])
    return builder.call(
        _code.get_or_insert_function(builder.module, kind, f"llvm.{name}.v{vector.type.count}f32"), [vector]
    )
