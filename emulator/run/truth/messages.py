"""Arrays on the pipe to the process that writes a truth file: a length, a line of JSON with their shapes, their bytes.

A message is a mapping of data sets to rows that are added to them; that of the length 0 ends the file in good order.
"""

from __future__ import annotations

import json
import math
import struct
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

__all__ = ["Rows", "decoded", "encoded"]

Rows = Mapping[str, npt.NDArray[Any]]
"""Rows to add, by the path of their data set."""

_HEAD = struct.Struct("<I")
_MOST_HEAD_BYTES = 1 << 20


def encoded(rows: Rows) -> bytes:
    """Return the message; the arrays may change afterwards."""
    head = json.dumps([[name, values.dtype.str, values.shape] for name, values in rows.items()]).encode()
    return b"".join(
        [_HEAD.pack(len(head)), head, *(np.ascontiguousarray(values).tobytes() for values in rows.values())]
    )


def decoded(read: Callable[[int], bytes]) -> dict[str, npt.NDArray[Any]] | None:
    """Return the next message of `read`, which gives that many bytes; None at the end of its input.

    Raises ValueError for what is no message.
    """
    head = read(_HEAD.size)
    if len(head) < _HEAD.size:
        return None
    (length,) = _HEAD.unpack(head)
    if length > _MOST_HEAD_BYTES:
        raise ValueError("the other process sends what is no truth")
    rows = {}
    for name, kind, shape in json.loads(read(length)):
        dtype = np.dtype(kind)
        data = read(math.prod(shape) * dtype.itemsize)
        if len(data) < math.prod(shape) * dtype.itemsize:
            return None  # the process that feeds this one was killed
        rows[name] = np.frombuffer(data, dtype).reshape(shape)
    return rows
