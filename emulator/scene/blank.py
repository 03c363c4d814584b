"""Nothing to see: the scene of a rig whose events come from elsewhere."""

from __future__ import annotations

from emulator.light import Light, Scene

__all__ = ["Blank"]


class Blank(Scene):
    """Darkness."""

    def __init__(self, size: tuple[int, int]) -> None:
        self._size = size

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
        out.fill(0)

    @property
    def has_rate(self) -> bool:
        """True: nothing changes."""
        return True

    def light_and_rate(self, t_ns: int, light: Light, rate: Light) -> None:
        """Write zeros."""
        light.fill(0)
        rate.fill(0)

    def close(self) -> None:
        """There is nothing to give back."""
