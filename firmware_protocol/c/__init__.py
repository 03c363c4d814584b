"""The decoder for firmware, in C99: where its sources are, for whoever compiles them.

The library itself is `evstim.h` and `evstim_*.c` in this folder; `mps2_an385/` holds a complete firmware around it for
an emulated Cortex-M3 board. How to use them is told in docs/firmware.md.
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["FOLDER", "sources"]

FOLDER = Path(__file__).parent
"""The folder to give the compiler as include path."""


def sources() -> list[Path]:
    """Return the library's C files."""
    return sorted(FOLDER.glob("evstim_*.c"))
