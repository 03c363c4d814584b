"""What vector loops need to run at full width: arrays that begin at a cache line, and 512-bit vectors where they pay.

Both were measured on a Xeon of the Granite Rapids class, on the quiet pass of 346 x 260 pixels: 249 us as numpy and
LLVM have it, 227 us with aligned arrays, 192 us with both. Without alignment wide vectors gain half of that, because
each of their accesses crosses a cache line.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, cast

import numpy as np
import numpy.typing as npt
from llvmlite import ir
from numba import types
from numba.extending import intrinsic

__all__ = ["aligned_zeros", "use_widest_vectors"]

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
