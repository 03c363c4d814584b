"""A reader of EVT2 and EVT2.1 words in plain Python, written from the tables of the published formats."""

import struct

import numpy as np

from firmware_protocol.events import EDGE, EVENT, EdgeKind

OFF, ON, TIME_HIGH, TRIGGER = 0x0, 0x1, 0x8, 0xA


def words_of(data, form):
    """Return whole words of 64 bits (EVT2.1), or of 32 bits (EVT2), as integers."""
    if form == "evt2":
        return [word for (word,) in struct.iter_unpack("<I", data[: len(data) // 4 * 4])]
    halves = struct.iter_unpack("<II", data[: len(data) // 8 * 8])
    if form == "evt21":
        return [second << 32 | first for first, second in halves]
    return [first << 32 | second for first, second in halves]


def by_the_tables(data, form):
    """Return events and edges; a turn of the time is counted only from the largest time high to 0, as OpenEB does."""
    events, edges, high, turns = [], [], None, 0
    for word in words_of(data, form):
        upper, mask = (word, 1) if form == "evt2" else (word >> 32, word & 0xFFFF_FFFF)
        kind = upper >> 28
        if kind == TIME_HIGH:
            following = upper & 0x0FFF_FFFF
            turns += high == 0x0FFF_FFFF and following == 0
            high = following
        elif high is None:
            continue
        t = None if high is None else turns << 34 | high << 6 | upper >> 22 & 0x3F
        if kind in (OFF, ON):
            x, y = upper >> 11 & 0x7FF, upper & 0x7FF
            events += [(t, x + bit, y, kind == ON) for bit in range(32) if mask >> bit & 1]
        elif kind == TRIGGER:
            edges.append((t, EdgeKind.RISING if upper & 1 else EdgeKind.FALLING, upper >> 8 & 0x1F, 0))
    return np.array(events, EVENT), np.array(edges, EDGE)
