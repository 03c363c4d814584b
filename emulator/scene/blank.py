"""Nothing to see: the scene of a rig whose events come from elsewhere."""

from __future__ import annotations

from emulator.light import Light, Region, Scene

__all__ = ["Blank"]


class Blank(Scene):
    """Darkness."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size
        self._outs: tuple[Light, Light | None] | None = None
        self._changed: Region | None = None

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def motion_bound_px_s(self) -> float:
        """Nothing moves."""
        return 0.0

    def light(self, t_ns: int, out: Light) -> None:
        """Write zeros."""
        self._clear(out, None)

    @property
    def has_rate(self) -> bool:
        """True: nothing changes."""
        return True

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write zeros."""
        self._clear(light, rate)

    @property
    def changed(self) -> Region | None:
        """Nothing, once the arrays were written."""
        return self._changed

    def _clear(self, light: Light, rate: Light | None) -> None:
        """Write zeros, unless these are the arrays of the last call."""
        known = self._outs is not None and self._outs[0] is light and self._outs[1] is rate
        self._changed = Region(0, 0, 0, 0) if known else None
        if known:
            return
        self._outs = light, rate
        light.fill(0)
        if rate is not None:
            rate.fill(0)

    def close(self) -> None:
        """There is nothing to give back."""
