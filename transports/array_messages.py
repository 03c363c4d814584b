"""Messages of named values between two processes of one run: arrays as their bytes, everything else as JSON.

    u32 length of the head | head, JSON: [name, type, shape] of an array, [name, null, value] of another value | bytes

Nothing that a receiver executes is sent: the sender may have read a file that takes over its process.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from numpy.lib import format as npy

Values = Mapping[str, Any]
"""Arrays and values of JSON by name."""

_LENGTH = struct.Struct("<I")
_MOST_HEAD_BYTES = 1 << 20
_FOREIGN = "the other process sends something else"


def encoded(values: Values) -> list[bytes | memoryview]:
    """Return a message in pieces; those of arrays share the arrays' memory where it is contiguous."""
    head: list[list[Any]] = []
    pieces: list[bytes | memoryview] = []
    for name, value in values.items():
        if not isinstance(value, np.ndarray):
            head.append([name, None, value])
            continue
        head.append([name, npy.dtype_to_descr(value.dtype), value.shape])
        pieces.append(np.ascontiguousarray(value).reshape(-1).view(np.uint8).data)
    text = json.dumps(head).encode()
    return [_LENGTH.pack(len(text)), text, *pieces]


def decoded(read: Callable[[int], bytes | bytearray], most_bytes: int = 1 << 40) -> dict[str, Any] | None:
    """Return the next message of `read(size)`, which returns fewer bytes at the end of its input; None at that end.

    The arrays can be written where `read` returns a bytearray. Raises ValueError for other bytes, and for an array of
    more than `most_bytes`.
    """
    start = read(_LENGTH.size)
    if len(start) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(start)
    if length > _MOST_HEAD_BYTES:
        raise ValueError(_FOREIGN)
    text = read(length)
    if len(text) < length:
        return None
    values: dict[str, Any] = {}
    for name, descr, rest in json.loads(text):
        if descr is None:
            values[name] = rest
            continue
        dtype = npy.descr_to_dtype(_with_tuples(descr))
        size = math.prod(rest) * dtype.itemsize
        if not 0 <= size <= most_bytes:
            raise ValueError(_FOREIGN)
        data = read(size)
        if len(data) < size:
            return None  # the sender was killed
        values[name] = np.frombuffer(data, dtype).reshape(rest)
    return values


def _with_tuples(descr: Any) -> Any:
    """Return a type in the form that numpy needs: JSON has no tuples."""
    return descr if isinstance(descr, str) else [tuple(field) for field in descr]
