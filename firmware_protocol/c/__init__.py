"""The decoder for firmware, in C99: the location of its sources.

The library itself is `evstim.h` and `evstim_*.c` in this folder; `mps2_an385/` holds a complete firmware with it for an
emulated Cortex-M3 board. docs/firmware.md describes their use.

`evstim_renderer.h` stands alone: the client for external renderers on POSIX systems (docs/renderers.md).
"""

from __future__ import annotations

from pathlib import Path

__all__ = ["FOLDER", "sources"]

FOLDER = Path(__file__).parent
"""The folder to give the compiler as include path."""


def sources() -> list[Path]:
    """Return the library's C files."""
    return sorted(FOLDER.glob("evstim_*.c"))
