"""AEDAT 3.1, the format of cAER: text lines, then packets of events of one kind, little-endian.

    i16 kind   i16 source   i32 event size   i32 offset of the time   i32 wraps of 2^31 us
    i32 capacity   i32 number   i32 valid ones   then the events, 8 bytes each of these kinds:
    0 special   u32: bit 0 valid, 7..1 what, 31..8 data     i32 us
    1 polarity  u32: bit 0 valid, 1 ON, 16..2 y, 31..17 x   i32 us

Row 0 is the upper one. Frames and IMU samples (kinds 2, 3, 4) are left out.

Sources: docs.inivation.com, "AEDAT 3.1"; libcaer, events/common.h, polarity.h, special.h.
"""

from __future__ import annotations

import re

import numpy as np

from firmware_protocol.edges import EDGE, EdgeKind, Edges, empty_edges
from firmware_protocol.events import EVENT, Events

__all__ = ["Aedat31Decoder", "aedat31_header", "encode_aedat31", "parse_aedat31_header"]

LIMIT_PX = 1 << 15
_HEAD = np.dtype(
    [("kind", "<i2"), ("source", "<i2")]
    + [(name, "<i4") for name in ("event_bytes", "time_at", "wraps", "capacity", "number", "valid")]
)
_EVENT = np.dtype([("data", "<u4"), ("t", "<i4")])
_SPECIAL, _POLARITY = 0, 1
_MOST_PACKET = 1 << 28  # bytes
_END = b"#!END-HEADER\r\n"


def aedat31_header(source: str, started: str = "1970-01-01 00:00:00 (TZ+0000)") -> bytes:
    """Return the text lines of a file of the camera `source`, such as "DAVIS346"."""
    lines = ("#!AER-DAT3.1", "#Format: RAW", f"#Source 1: {source}", f"#Start-Time: {started}")
    return "".join(f"{line}\r\n" for line in lines).encode("ascii") + _END


def encode_aedat31(events: Events, edges: Edges | None = None) -> bytes:
    """Return the packets of events (n,) EVENT and edges (m,) EDGE, each sorted."""
    edges = empty_edges() if edges is None else edges
    x, y = events["x"].astype(np.uint32), events["y"].astype(np.uint32)
    polarity = (x << 17) | (y << 2) | (events["on"].astype(np.uint32) << 1) | 1
    special = (edges["kind"].astype(np.uint32) << 1) | 1
    return _packets(_SPECIAL, special, edges["t"]) + _packets(_POLARITY, polarity, events["t"])


def _packets(kind: int, data: np.ndarray, t: np.ndarray) -> bytes:
    """Return packets of one kind, a new one where the 31 bits of time wrap."""
    if not len(t):
        return b""
    wraps = (t >> np.uint64(31)).astype(np.int64)
    starts = np.flatnonzero(np.diff(wraps, prepend=-1))
    body = np.empty(len(t), _EVENT)
    body["data"], body["t"] = data, t & np.uint64(0x7FFFFFFF)
    packets = []
    for start, end in zip(starts, [*starts[1:], len(t)], strict=True):
        head = np.zeros(1, _HEAD)
        head["kind"], head["source"], head["event_bytes"], head["time_at"] = kind, 1, _EVENT.itemsize, 4
        head["wraps"] = wraps[start]
        head["capacity"] = head["number"] = head["valid"] = end - start
        packets.append(head.tobytes() + body[start:end].tobytes())
    return b"".join(packets)


def parse_aedat31_header(head: bytes) -> tuple[int, str]:
    """Return where the packets of a file begin, and the name of its first source; raises ValueError."""
    if not head.startswith(b"#!AER-DAT3.1"):
        raise ValueError("it is no AEDAT 3.1 file: it does not begin with #!AER-DAT3.1")
    end = head.find(_END)
    if end < 0:
        raise ValueError("its lines of text have no end (#!END-HEADER)")
    source = re.search(rb"#Source \d+: ([ -~]*)\r\n", head[:end])
    return end + len(_END), source[1].decode("ascii") if source else ""


class Aedat31Decoder:
    """Reads packets piece by piece.

    Attributes
    ----------
    others : frames, IMU samples and special events without meaning here so far.
    """

    def __init__(self) -> None:
        self._rest = b""
        self.others = 0

    def decode(self, data: bytes) -> tuple[Events, Edges]:
        """Return events (n,) EVENT and edges (m,) EDGE of the packets that are complete with the next bytes.

        Raises ValueError for a packet that cannot be one.
        """
        data = self._rest + data
        events, edges, start = [np.zeros(0, EVENT)], [np.zeros(0, EDGE)], 0
        while len(data) - start >= _HEAD.itemsize:
            head = np.frombuffer(data, _HEAD, 1, start)[0]
            body_at = start + _HEAD.itemsize
            end = body_at + _body_bytes(head)
            if end > len(data):
                break
            self._take(head, data[body_at:end], events, edges)
            start = end
        self._rest = data[start:]
        return np.concatenate(events), np.concatenate(edges)

    def _take(self, head: np.void, body: bytes, events: list[Events], edges: list[Edges]) -> None:
        if head["kind"] not in (_SPECIAL, _POLARITY) or head["event_bytes"] != _EVENT.itemsize:
            self.others += int(head["number"])
            return
        records = np.frombuffer(body, _EVENT, int(head["number"]))
        records = records[records["data"] & 1 == 1]
        t = (np.int64(head["wraps"]) << 31) + records["t"]
        if head["kind"] == _POLARITY:
            events.append(_events(records["data"], t))
            return
        what = (records["data"] >> 1) & 0x7F
        known = np.isin(what, [int(kind) for kind in EdgeKind])
        self.others += int(np.count_nonzero(~known))
        edges.append(_edges(what[known], t[known]))


def _body_bytes(head: np.void) -> int:
    """Return the bytes of a packet's events; raises ValueError."""
    number, event_bytes = int(head["number"]), int(head["event_bytes"])
    capacity = max(int(head["capacity"]), number)
    if not 0 <= head["kind"] <= 100 or number < 0 or not event_bytes > 0 or number * event_bytes > _MOST_PACKET:
        raise ValueError(f"a packet of kind {head['kind']} with {number} events of {event_bytes} bytes")
    return number * event_bytes if capacity >= 0 else 0


def _events(data: np.ndarray, t: np.ndarray) -> Events:
    events = np.zeros(len(t), EVENT)
    events["t"], events["x"], events["y"] = t, data >> 17, (data >> 2) & 0x7FFF
    events["on"] = (data >> 1) & 1
    return events


def _edges(what: np.ndarray, t: np.ndarray) -> Edges:
    edges = np.zeros(len(t), EDGE)
    edges["t"], edges["kind"] = t, what
    return edges
