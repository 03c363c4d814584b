"""How the sensor's loops are compiled by numba, and why so. Compiled code is kept on disk; the first call says so.

    kernel           plain loops over arrays that the caller owns
    vector_kernel    the same, for loops that must become vectors
    kernel_that_allocates   may make arrays; for the few functions at the top

Three options decide whether a loop is fast, and each cost a factor of 5 to 40 here before it was found:

- error_model="numpy": a division by zero gives inf or NaN. In the Python model it raises, which makes a loop with a division one
  with an early exit, and no such loop becomes vectors.
- _nrt=False: no reference counting. Otherwise passing an array to a helper counts a reference up and down with atomic
  operations, and numba leaves them in the loop when the helper has more than one way out: 80 ns a call instead of 2.
- fastmath contracts a*b + c to one rounding and does nothing else. NaN and infinity keep their meaning, and sums their order.
"""

from __future__ import annotations

from numba import njit

__all__ = ["kernel", "kernel_that_allocates", "vector_kernel"]

kernel = njit(cache=True, nogil=True, error_model="numpy", _nrt=False)
vector_kernel = njit(cache=True, nogil=True, error_model="numpy", _nrt=False, fastmath={"contract"})
kernel_that_allocates = njit(cache=True, nogil=True, error_model="numpy")
