"""The EVENT and EDGE records that all packages share, fast copies of them, and the types of arrays.

The record of an event:

    t   u64   microseconds since the start of the stream
    x   u16   column, 0 on the left
    y   u16   row, 0 on top
    on  bool  True: it got brighter (ON), False: darker (OFF)

The layout is packed (13 bytes) and is the one of `faery` and `neuromorphic_drivers`, so arrays pass between them
without a copy. numpy copies a structured array field by field: 6 ns an event, where moving the 13 bytes takes 0.1 ns.
Code that handles millions of events a second copies and joins them with the functions here, as raw bytes.

The record of an edge on a camera's external input:

    t        u64   microseconds since the start of the stream
    kind     u8    EdgeKind, numbered as the special events of libcaer (libcaer 3.3.15, events/special.h)
    channel  u8    number of the input; the DAVIS346 has one, 0
    seq      u16   number of the edge at its source (the SYNC counter of a CAN bus), 0 where the source counts none

The layout is packed (12 bytes), like that of the events.
"""

from __future__ import annotations

import reprlib
from collections.abc import Sequence
from enum import IntEnum
from typing import Any

import numpy as np
import numpy.typing as npt

from firmware_protocol.bounds import unshared

Floats = npt.NDArray[np.float64]
Float32s = npt.NDArray[np.float32]
Int64s = npt.NDArray[np.int64]
Int32s = npt.NDArray[np.int32]
UInt16s = npt.NDArray[np.uint16]
Bytes = npt.NDArray[np.uint8]
Mask = npt.NDArray[np.bool_]

EVENT = np.dtype([("t", "<u8"), ("x", "<u2"), ("y", "<u2"), ("on", "?")])

Events = npt.NDArray[np.void]
"""An array of EVENT records, shape (n,), sorted by t."""


def empty_events(n: int = 0) -> Events:
    """Return an array of `n` zeroed events."""
    return np.zeros(n, EVENT)


def make_events(t: npt.ArrayLike, x: npt.ArrayLike, y: npt.ArrayLike, on: npt.ArrayLike) -> Events:
    """Return (n,) EVENT with these fields, t (n,) us."""
    return _of_columns(EVENT, t, x=x, y=y, on=on)


def _of_columns(dtype: np.dtype[np.void], t: npt.ArrayLike, **columns: npt.ArrayLike) -> npt.NDArray[np.void]:
    records = np.zeros(np.size(t), dtype)
    records["t"] = t
    for name, column in columns.items():
        records[name] = column
    return records


_RECORD = f"V{EVENT.itemsize}"


def copy_events(events: npt.NDArray[np.void]) -> npt.NDArray[np.void]:
    """Return a contiguous copy of `events`, (n,) EVENT, or of other packed records."""
    return events.view(f"V{events.itemsize}").copy().view(events.dtype)


def join_events(parts: Sequence[Events]) -> Events:
    """Return the (n,) EVENT arrays of `parts` one after another; a single one is returned as it is, not copied."""
    filled = [part for part in parts if len(part)]
    if len(filled) < 2:
        return filled[0] if filled else empty_events()
    return np.concatenate([part.view(_RECORD) for part in filled]).view(EVENT)


def bytes_of(records: npt.NDArray[np.void]) -> npt.NDArray[np.uint8]:
    """Return the bytes of packed records, such as (n,) EVENT, for compiled code; (n * size,).

    Records that are read-only or have gaps are copied: compiled code has a version for each kind of array.
    """
    is_simple = records.flags.c_contiguous and records.flags.writeable
    return (records if is_simple else copy_events(records)).view(np.uint8)


class Kept:
    """Base of frozen dataclasses that others fill: arrays become read-only copies, lists tuples; printed on a line."""

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            object.__setattr__(self, name, unshared(value, read_only))

    def __repr__(self) -> str:
        shown = {k: f"array {v.shape}" if isinstance(v, np.ndarray) else reprlib.repr(v) for k, v in vars(self).items()}
        return f"{type(self).__name__}({', '.join(f'{name}={text}' for name, text in shown.items())})"


def read_only(array: npt.NDArray[Any]) -> npt.NDArray[Any]:
    """Return a copy of an array that cannot be written to."""
    copy = copy_events(array) if array.dtype.names else np.array(array)
    copy.flags.writeable = False
    return copy


EDGE = np.dtype([("t", "<u8"), ("kind", "u1"), ("channel", "u1"), ("seq", "<u2")])

Edges = npt.NDArray[np.void]
"""An array of EDGE records, shape (n,), sorted by t."""


class EdgeKind(IntEnum):
    """Kind of a change on the input."""

    RISING = 2
    FALLING = 3
    PULSE = 4


def empty_edges(n: int = 0) -> Edges:
    """Return an array of `n` zeroed edges."""
    return np.zeros(n, EDGE)


def make_edges(t: npt.ArrayLike, kind: npt.ArrayLike, channel: npt.ArrayLike = 0, seq: npt.ArrayLike = 0) -> Edges:
    """Return (n,) EDGE with these fields, t us, (n,) or a number: one edge."""
    return _of_columns(EDGE, t, kind=kind, channel=channel, seq=seq)


def level_changes(edges: Edges, pulse_us: int) -> Edges:
    """Return edges (n,) EDGE as changes of the signal, sorted: a pulse rises at its time and falls `pulse_us` later."""
    is_pulse = edges["kind"] == EdgeKind.PULSE
    begins, ends = edges.copy(), edges[is_pulse]
    begins["kind"][is_pulse] = EdgeKind.RISING
    ends["kind"] = EdgeKind.FALLING
    ends["t"] += np.uint64(pulse_us)
    changes = np.concatenate([begins, ends])
    return changes[np.argsort(changes["t"], kind="stable")]
