"""EVENT and EDGE records as bytes, in compiled loops.

Places are unsigned: numba then adds no test for an index from the end, and the compiler joins the bytes of a number
into one load or store.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from firmware_protocol.evt3.compiled import kernel

__all__ = ["EDGE_BYTES", "EVENT_BYTES", "put_short", "put_time", "short_at", "time_at"]

_Bytes = npt.NDArray[np.uint8]

EVENT_BYTES, EDGE_BYTES = 13, 12


@kernel
def time_at(data: _Bytes, at: int) -> int:
    """Return the eight bytes from `at` on as a time; it is negative from 2**63 us on."""
    place, t = np.uint64(at), np.int64(0)
    for k in range(8):
        t |= np.int64(data[place + np.uint64(k)]) << np.int64(8 * k)
    return int(t)


@kernel
def short_at(data: _Bytes, at: int) -> int:
    """Return the two bytes from `at` on."""
    place = np.uint64(at)
    return int(np.int64(data[place]) | np.int64(data[place + np.uint64(1)]) << np.int64(8))


@kernel
def put_time(data: _Bytes, at: int, t: int) -> None:
    """Write eight bytes."""
    place = np.uint64(at)
    for k in range(8):
        data[place + np.uint64(k)] = (t >> (8 * k)) & 255


@kernel
def put_short(data: _Bytes, at: int, value: int) -> None:
    """Write the two low bytes of `value`."""
    place = np.uint64(at)
    data[place] = value & 255
    data[place + np.uint64(1)] = (value >> 8) & 255
