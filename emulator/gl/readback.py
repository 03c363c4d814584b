"""How a picture comes from what draws it to the processor's memory.

    direct   the picture's own pixels are copied when they are asked for. With a software renderer that is all there is
             to do: the picture is in the processor's memory already
    ring     the renderer is told at once to copy them into a buffer (a pixel-pack buffer), which is mapped when they
             are asked for. A graphics card copies while the processor does something else; mapping waits for that copy
             alone and so is the fence

Both hold the same bits. There are as many places for pictures as may be under way at a time.
"""

from __future__ import annotations

import os
from collections import deque
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np

from emulator.gl.context import is_software
from emulator.light import Light, SceneError
from emulator.tables.typed_table import unknown

if TYPE_CHECKING:
    import moderngl

__all__ = ["READBACK", "UNDER_WAY", "Readback", "Strategy", "strategy_for"]

Strategy = Literal["direct", "ring"]

READBACK = "EVSTIM_READBACK"
"""The environment's variable that chooses a strategy."""

UNDER_WAY = 3
"""Pictures that can be drawn before the first of them is taken."""


def strategy_for(renderer: str) -> Strategy:
    """Return the strategy for a renderer of that name: the environment's, else what suits it.

    Raises
    ------
    SceneError
        The environment asks for one that is none.
    """
    by_name: dict[str, Strategy] = {name: name for name in get_args(Strategy)}
    asked = os.environ.get(READBACK) or ("direct" if is_software(renderer) else "ring")
    if asked not in by_name:
        raise SceneError(f"{READBACK}: {unknown(asked, list(by_name))}")
    return by_name[asked]


class _Place:
    """A picture of R32F pixels, and the buffer it is copied into if it is given one."""

    def __init__(self, gl: moderngl.Context, size: tuple[int, int], strategy: Strategy) -> None:
        self.texture = gl.texture(size, 1, dtype="f4")
        self.target = gl.framebuffer([self.texture])
        self.target.clear()
        self._buffer = gl.buffer(reserve=4 * size[0] * size[1]) if strategy == "ring" else None

    def send(self) -> None:
        if self._buffer is not None:
            self.target.read_into(self._buffer, components=1, dtype="f4")

    def receive(self, out: Light) -> None:
        if not out.flags.c_contiguous:
            whole = np.empty(out.shape, np.float32)
            self.receive(whole)
            out[:] = whole
        elif self._buffer is not None:
            self._buffer.read_into(out)
        else:
            self.target.read_into(out, components=1, dtype="f4")


class Readback:
    """Places for pictures of `size` = (width, height) in the current context, used one after another."""

    def __init__(self, gl: moderngl.Context, size: tuple[int, int], strategy: Strategy) -> None:
        self.strategy = strategy
        self._free = deque(_Place(gl, size, strategy) for _ in range(UNDER_WAY))
        self._sent: deque[_Place] = deque()

    @property
    def target(self) -> moderngl.Framebuffer:
        """What the next picture is to be drawn on.

        Raises
        ------
        SceneError
            All places hold pictures that were not taken.
        """
        if not self._free:
            raise SceneError(f"{UNDER_WAY} pictures are under way: take one before the next is drawn")
        return self._free[0].target

    @property
    def last(self) -> moderngl.Texture:
        """The picture that was drawn last, R32F, its first row first; until the next one is drawn."""
        return (self._sent or self._free)[-1].texture

    def send(self) -> None:
        """Let the picture on `target` come."""
        place = self._free.popleft()
        place.send()
        self._sent.append(place)

    def receive(self, out: Light) -> None:
        """Write the picture that was sent first, of those under way, into `out`, (height, width) float32.

        Raises
        ------
        SceneError
            None is under way.
        """
        if not self._sent:
            raise SceneError("no picture is under way: draw one before it is taken")
        place = self._sent.popleft()
        place.receive(out)
        self._free.append(place)
