"""Optical flow of a checkerboard: the motion of the board. A pattern on the chip has no distance: there is no depth."""

from __future__ import annotations

from emulator.geometry.seen import Given, SceneGeometry, Seen

__all__ = ["BoardGeometry"]


class BoardGeometry(SceneGeometry):
    """The motion of a board, px/s to the right and down."""

    names = ("board",)
    gives: frozenset[Given] = frozenset({"flow", "labels"})

    def __init__(self, right_px_s: float, down_px_s: float) -> None:
        self._flow = right_px_s, down_px_s

    def look(self, t_ns: int, out: Seen) -> None:
        """Write flow and labels, the same everywhere at all times."""
        out.flow[:] = self._flow
        out.labels.fill(1)
