"""Choice of the painter of bodies and terrain: the CPU, unless the environment or the rig selects GL.

    EVSTIM_RENDERER unset or empty    run.painter of the rig, "cpu" where the rig has no such key
    EVSTIM_RENDERER=cpu               the CPU, for every rig
    EVSTIM_RENDERER=gl                GL, by the first renderer that is no software renderer, else the first that works
    EVSTIM_RENDERER=llvmpipe          GL, by the renderer with this in its name

The presence of a graphics card selects nothing: a rig and a seed give the same events on every machine. GL averages
points in each pixel, without time derivative; the CPU gives the exact mean (docs/accuracy.md has both).
"""

from __future__ import annotations

import os
from typing import Literal

from emulator.gl.context import WANTED

__all__ = ["QUICK_LOOK", "Painter", "selected_painter"]

Painter = Literal["cpu", "gl"]

QUICK_LOOK = (
    'GL draws, by points in each pixel: a quick look, whose events differ from those of run.painter = "cpu" '
    f"(the default, with {WANTED} unset)"
)
"""Note of a scene that GL draws."""


def selected_painter(of_rig: Painter) -> Painter:
    """Return the painter: that of the environment, else that of the rig."""
    wanted = os.environ.get(WANTED, "").strip().lower()
    if not wanted:
        return of_rig
    return "cpu" if wanted == "cpu" else "gl"
