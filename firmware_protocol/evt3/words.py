"""The words of EVT3, and the text before them in a file.

A word has 16 bits, little-endian:

    15..12  11         10..0
    0x0     -          y                          row of the events that follow
    0x2     polarity   x                          one event
    0x3     polarity   x                          first column of the vectors that follow; no event by itself
    0x4     12 columns, a bit each: bit i is column x + i. The next vector begins at x + 12
    0x5     8 columns in bits 7..0. The next vector begins at x + 8
    0x6     time, bits 11..0, us
    0x8     time, bits 23..12
    0xA     channel in bits 11..8, edge in bit 0 (1: rising)      external trigger
    0xE     subtype: numbers of the sensor, with 0xF and 0x7 as their digits. Nothing to us

Row, time and the place of vectors hold until a word changes them. The time wraps every 2^24 us (16.8 s): a reader
counts a wrap when the high part goes back by more than half its range, so every step of it must be below 2048 (8.4 s).
OpenEB wants both sides of a wrap, 0xFFF and 0x000, takes 0x4, 0x4, 0x5 as one unit of 32 columns, and by default drops
a unit that passes the sensor's last column, even where no bit beyond it is set (hal, evt3_validator.h).

Sources: docs.prophesee.ai, "EVT 3.0 Format"; OpenEB 5.1.1.
"""

from __future__ import annotations

__all__ = [
    "BASE", "HIGH", "HIGH_BITS", "LIMIT_PX", "LOW", "ROW", "SINGLE", "TRIGGER", "VECTOR_8", "VECTOR_12", "WINDOW_PX",
    "evt3_header", "next_high",
]  # fmt: skip

ROW, SINGLE, BASE, VECTOR_12, VECTOR_8, LOW, HIGH, TRIGGER = 0x0, 0x2, 0x3, 0x4, 0x5, 0x6, 0x8, 0xA
LIMIT_PX = 1 << 11
WINDOW_PX = 32
HIGH_BITS = 12  # of the time in a low word, and in a high word


def evt3_header(size: tuple[int, int]) -> bytes:
    """Return the text before the words of an EVT3 `.raw` file of a sensor of `size` = (width, height)."""
    width, height = size
    lines = ("evt 3.0", f"format EVT3;width={width};height={height}", f"geometry {width}x{height}", "end")
    return "".join(f"% {line}\n" for line in lines).encode("ascii")


def next_high(told: int, wanted: int, bits: int) -> int:
    """Return which full high part of a time to write next after `told`, on the way to `wanted` > `told`.

    A word holds `bits` bits of it. -1 is told before the first word, so every stream begins with high part 0.
    """
    wrap = 1 << bits
    quarter = wrap // 4
    if told >> bits == wanted >> bits and wanted - told < 2 * quarter:
        return wanted
    next_step = (told // quarter + 1) * quarter
    end_of_wrap = told | wrap - 1
    if end_of_wrap > told:
        next_step = min(next_step, end_of_wrap)
    return min(next_step, wanted)
