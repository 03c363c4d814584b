"""Logarithm, decay and exponential in float32 for loops that become vectors; the lowest bit of a word.

Calls to the mathematics library stop numba from vectorising a loop; these are plain arithmetic and become 8 or 16
lanes wide. Two measured effects determine their form:

- numba widens int32 arithmetic to int64, which keeps a loop scalar. So everything that touches the bits of a float
  is one intrinsic that goes from float32 to float32, and no integer is ever seen by numba.
- To round by adding and subtracting 1.5 x 2^23 works until a compiler that may re-associate deletes the pair. Here
  rounding is floor(x + 1/2), and the only licence given to the compiler is to contract a*b + c into one operation.

Sources: `natural_log` is Cephes `logf` (S. L. Moshier), split constant of ln 2 included; `decay` is 1 - e^-s from the
Taylor polynomial of 2^f - 1 on |f| <= 1/2. Against float64: log within 3e-7 relative or 6e-8 absolute, decay
within 3e-7 relative for s from 1e-12 to 80, so a step of nanoseconds still moves the filter by the right amount.

Vector loops run at full width with arrays that begin at a cache line, and 512-bit vectors where faster. The quiet pass
of 346 x 260 pixels took, on a Xeon of the Granite Rapids class, 249 us as numpy and LLVM have it, 227 with aligned
arrays, 192 with both. Without alignment each access of wide vectors crosses a cache line: they gain half of that.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import float32, types, uint64
from numba.extending import intrinsic

from emulator.sensor.numerics.compiled import lane

_SQRT_HALF_BITS = 0x3F3504F3
_MANTISSA_BITS = 23
_EXPONENT_BIAS = 127

_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8 = (
    np.float32(c)
    for c in (
        7.0376836292e-2, -1.1514610310e-1, 1.1676998740e-1, -1.2420140846e-1, 1.4249322787e-1,
        -1.6668057665e-1, 2.0000714765e-1, -2.4999993993e-1, 3.3333331174e-1,
    )
)  # fmt: skip
_LN2_HIGH = np.float32(0.693359375)
_LN2_LOW = np.float32(-2.12194440e-4)
_LOG2_E = np.float32(np.log2(np.e))
_E1, _E2, _E3, _E4, _E5, _E6, _E7 = (
    np.float32(np.log(2) ** k / np.prod(np.arange(1, k + 1, dtype=float))) for k in range(1, 8)
)
_HALF = np.float32(0.5)
_ONE = np.float32(1)
_NOTHING, _DEEPEST = np.float32(0), np.float32(80)

_Pair = tuple[Any, Any]


def _split(builder: ir.IRBuilder, bits: ir.Value) -> tuple[ir.Value, ir.Value]:
    """Return (exponent, bits of the mantissa in [sqrt 1/2, sqrt 2)) of a positive float's bits."""
    i32 = ir.IntType(32)
    above = builder.sub(bits, ir.Constant(i32, _SQRT_HALF_BITS))
    exponent = builder.ashr(above, ir.Constant(i32, _MANTISSA_BITS))
    return exponent, builder.sub(bits, builder.shl(exponent, ir.Constant(i32, _MANTISSA_BITS)))


def _exponent_of(typing_context: Any, x: Any) -> _Pair:
    """Return e of x = m 2^e with m in [sqrt 1/2, sqrt 2), as float32; x positive, finite, not denormal."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        exponent, _ = _split(builder, builder.bitcast(args[0], ir.IntType(32)))
        return builder.sitofp(exponent, ir.FloatType())

    return float32(float32), code


def _mantissa_of(typing_context: Any, x: Any) -> _Pair:
    """Return m of x = m 2^e with m in [sqrt 1/2, sqrt 2); x positive, finite, not denormal."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        _, mantissa = _split(builder, builder.bitcast(args[0], ir.IntType(32)))
        return builder.bitcast(mantissa, ir.FloatType())

    return float32(float32), code


def _power_of_two_of(typing_context: Any, k: Any) -> _Pair:
    """Return 2^k for a whole number k from -126 to 127 held in a float32."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        i32 = ir.IntType(32)
        biased = builder.add(builder.fptosi(args[0], i32), ir.Constant(i32, _EXPONENT_BIAS))
        return builder.bitcast(builder.shl(biased, ir.Constant(i32, _MANTISSA_BITS)), ir.FloatType())

    return float32(float32), code


def _lowest_bit_of(typing_context: Any, word: Any) -> _Pair:
    """Return the index of the lowest bit set in a 64-bit word that is not 0."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        return builder.cttz(args[0], ir.Constant(ir.IntType(1), 1))

    return uint64(uint64), code


_exponent, _mantissa, _power_of_two, lowest_bit = (
    cast(Callable[..., Any], intrinsic(code)) for code in (_exponent_of, _mantissa_of, _power_of_two_of, _lowest_bit_of)
)


@lane
def natural_log(x: np.float32) -> np.float32:
    """Return ln x in float32, for positive, finite x that is not denormal; anything else gives a finite nonsense."""
    e: np.float32 = _exponent(x)
    f: np.float32 = _mantissa(x) - _ONE
    f2 = f * f
    p = ((((((((_P0 * f + _P1) * f + _P2) * f + _P3) * f + _P4) * f + _P5) * f + _P6) * f + _P7) * f + _P8) * f
    return (p * f2 + e * _LN2_LOW - _HALF * f2) + f + e * _LN2_HIGH


@lane
def _two_to_the(y: np.float32) -> tuple[np.float32, np.float32]:
    """Return 2^k and 2^f - 1 for y = k + f, k whole and |f| <= 1/2."""
    k: np.float32 = np.floor(y + _HALF)
    f = y - k
    less_one = ((((((_E7 * f + _E6) * f + _E5) * f + _E4) * f + _E3) * f + _E2) * f + _E1) * f
    scale: np.float32 = _power_of_two(k)
    return scale, less_one


@lane
def decay(s: np.float32) -> np.float32:
    """Return 1 - e^-s in float32 for s >= 0 (from 80 on, the value at 80); good to the last bits for tiny s too."""
    scale, less_one = _two_to_the(-min(s, _DEEPEST) * _LOG2_E)
    result: np.float32 = (_ONE - scale) - scale * less_one
    return result


@lane
def exponential(x: np.float32) -> np.float32:
    """Return e^x in float32, within 3e-7 (1 + |x| / 4) relative; beyond +-80, the value at +-80."""
    scale, less_one = _two_to_the(max(min(x, _DEEPEST), -_DEEPEST) * _LOG2_E)
    result: np.float32 = scale + scale * less_one
    return result


@lane
def exponential_less_one(x: np.float32) -> np.float32:
    """Return e^x - 1 in float32, good to the last bits for tiny x too; beyond +-80, the value at +-80."""
    scale, less_one = _two_to_the(max(min(x, _DEEPEST), -_DEEPEST) * _LOG2_E)
    result: np.float32 = (scale - _ONE) + scale * less_one
    return result


@lane
def log_of_one_more(x: np.float32) -> np.float32:
    """Return ln(1 + x) in float32 for x above -1: good to 1e-7 and, for tiny x, to the last bits.

    The rounding of 1 + x is known exactly and added again; above 1/2 it is below the resolution of the logarithm.
    """
    total = _ONE + x
    rounded = x - (total - _ONE)
    result: np.float32 = natural_log(total) + (rounded if abs(x) < _HALF else _NOTHING)
    return result


_CACHE_LINE = 64
_WIDE_WITHOUT_SLOWING = "+avx512vbmi2"
"""LLVM uses 256 bits on all Intel processors, because the first with AVX-512 (Skylake, Cascade Lake) lowered their
clock for wider vectors. Those since Ice Lake hardly do, and have this feature."""
_ATTRIBUTE = '"prefer-vector-width"="512"'


def aligned_zeros(shape: int | tuple[int, ...], dtype: npt.DTypeLike = np.float32) -> Any:
    """Return an array of zeros that begins at a cache line."""
    kind = np.dtype(dtype)
    needed = math.prod(np.atleast_1d(shape).tolist()) * kind.itemsize
    memory = np.zeros(needed + _CACHE_LINE, np.uint8)
    begin = -memory.ctypes.data % _CACHE_LINE
    return memory[begin : begin + needed].view(kind).reshape(shape)


def _use_widest(typing_context: Any) -> tuple[Any, Any]:
    """Let LLVM use 512-bit vectors in the function that calls this, on processors that do not slow down for them."""

    def code(context: Any, builder: ir.IRBuilder, signature: Any, args: Any) -> ir.Value:
        features = context.codegen().magic_tuple()[2]  # numba keys its cache with the same ones
        if _WIDE_WITHOUT_SLOWING in features.split(","):
            set.add(builder.function.attributes, _ATTRIBUTE)  # llvmlite writes it out, and only its own add() refuses
        return context.get_dummy_value()

    return types.none(), code


use_widest_vectors = cast(Callable[[], None], intrinsic(_use_widest))
