"""The words of EVT2 and EVT2.1, and the text before them in a file.

An EVT2 word has 32 bits, little-endian:

    31..28  27..22           21..11  10..0
    0x0     time, bits 5..0  x       y                    one OFF event
    0x1     time, bits 5..0  x       y                    one ON event
    0x8     time, bits 33..6
    0xA     time, bits 5..0  channel in bits 12..8, edge in bit 0 (1: rising)     external trigger

A word of EVT2.1 has 64 bits: the upper half is the EVT2 word, with x a multiple of 32, and the lower half a bit for
each column from x on. "evt21" is little-endian, as of the GenX320: the lower half comes first. "evt21-legacy" is what
the IMX636 sends: two little-endian words of 32 bits, the upper half first.

The time wraps every 2^34 us (4.8 h). OpenEB counts a wrap of EVT2.1 only from the last high part to 0, so both are
written.

Sources: docs.prophesee.ai, "EVT 2.0 Format" and "EVT 2.1 Format"; OpenEB 5.1.1, evt21_event_types.h.
"""

from __future__ import annotations

from typing import Literal

__all__ = ["HIGH", "HIGH_BITS", "LOW_BITS", "ON", "TRIGGER", "Form", "evt2_header"]

Form = Literal["evt2", "evt21", "evt21-legacy"]

ON, HIGH, TRIGGER = 0x1, 0x8, 0xA
LOW_BITS, HIGH_BITS = 6, 28


def evt2_header(size: tuple[int, int], form: Form) -> bytes:
    """Return the text before the words of a `.raw` file of a sensor of `size` = (width, height)."""
    width, height = size
    version, name = ("2.0", "EVT2") if form == "evt2" else ("2.1", "EVT21")
    endianness = {"evt2": "", "evt21": ";endianness=little", "evt21-legacy": ";endianness=legacy"}[form]
    lines = [f"evt {version}", f"format {name};width={width};height={height}{endianness}"]
    lines += ["endianness legacy"] if form == "evt21-legacy" else []
    lines += [f"geometry {width}x{height}", "end"]
    return "".join(f"% {line}\n" for line in lines).encode("ascii")
