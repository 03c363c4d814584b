"""Edges on a camera's external input, and its own marks, as frames: what the EDGE record says, in eight bytes.

    u32 time in us, low 32 bits | u8 kind | u8 channel | u16 seq

Little-endian; kinds are those of `EdgeKind`.
"""

from __future__ import annotations

import struct

from firmware_protocol.can_frames.canopen import ObjectError
from firmware_protocol.can_frames.raw_events import unwrapped
from firmware_protocol.edges import Edges, empty_edges

__all__ = ["pack_marks", "unpack_mark"]

_MARK = struct.Struct("<IBBH")


def pack_marks(edges: Edges) -> list[bytes]:
    """Return the data of one frame for each of edges (n,)."""
    return [_MARK.pack(int(e["t"]) & 0xFFFF_FFFF, int(e["kind"]), int(e["channel"]), int(e["seq"])) for e in edges]


def unpack_mark(data: bytes, near_us: int) -> Edges:
    """Return the edge of a frame, shape (1,), its time nearest to `near_us`; raises ObjectError."""
    if len(data) != _MARK.size:
        raise ObjectError(f"a mark has {_MARK.size} bytes, not {len(data)}")
    t, kind, channel, seq = _MARK.unpack(data)
    edges = empty_edges(1)
    edges[0] = unwrapped(t, 32, near_us), kind, channel, seq
    return edges
