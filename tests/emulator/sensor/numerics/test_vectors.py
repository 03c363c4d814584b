"""Arrays begin at a cache line; a loop that asks for wide vectors gets them where the processor does not slow down."""

import numpy as np
import pytest
from numba import njit
from numba.core.registry import cpu_target

from emulator.sensor.numerics.elementary import aligned_zeros, use_widest_vectors
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.presets import PRESETS

WIDE = "+avx512vbmi2" in cpu_target.target_context.codegen().magic_tuple()[2].split(",")


@pytest.mark.parametrize("shape", [1, 7, (3, 5), (176, 10, 512)])
@pytest.mark.parametrize("dtype", [np.float32, np.uint8, np.int64])
def test_arrays_begin_at_a_cache_line_and_are_zero(shape, dtype):
    for _ in range(5):
        array = aligned_zeros(shape, dtype)
        assert array.ctypes.data % 64 == 0
        assert array.dtype == dtype
        assert array.shape == np.empty(shape).shape
        assert array.flags.c_contiguous
        assert array.flags.writeable
        assert not array.any()


def test_the_state_of_an_array_begins_at_a_cache_line():
    assert PixelArray(PRESETS["davis346"], 1).state.fields.ctypes.data % 64 == 0


def squared(values, out):
    for i in range(512):
        out[i] = values[i] * values[i]


def squared_widely(values, out):
    use_widest_vectors()
    for i in range(512):
        out[i] = values[i] * values[i]


def test_only_a_function_that_asks_has_wide_vectors_and_only_where_they_pay():
    values = np.arange(512, dtype=np.float32)
    for function, asks in ((squared, False), (squared_widely, True)):
        compiled, out = njit(function), np.zeros(512, np.float32)
        compiled(values, out)
        np.testing.assert_array_equal(out, values * values)
        (code,) = compiled.inspect_llvm().values()
        assert ('"prefer-vector-width"="512"' in code) == (asks and WIDE)
