"""Choice between GL and the CPU: GL draws where a graphics card works, or where the environment asks for it.

The environment variable EVSTIM_RENDERER chooses instead: `cpu`, or part of a GL renderer's name (see `gl.context`).
"""

from __future__ import annotations

import os
from pathlib import Path

from emulator.gl.context import WANTED, probe

__all__ = ["draws_on_a_card"]

_CARDS = ("/dev/dri", "/dev/nvidia0")


def draws_on_a_card() -> bool:
    """Tell whether GL draws: the environment asks for a GL renderer, or there is a graphics card that works."""
    wanted = os.environ.get(WANTED, "").strip().lower()
    if wanted:
        return wanted != "cpu"
    if not any(Path(card).exists() for card in _CARDS):
        return False
    found = probe()
    return found.available and not found.is_software
