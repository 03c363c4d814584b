"""The pictures of a scene, one after another, in buffers that are used again."""

from __future__ import annotations

import numpy as np

from emulator.light import Light, PixelLight, Region, Scene

__all__ = ["Pictures"]


class Pictures:
    """Draws a scene's light, with its time derivative where the scene has it and the pixels' method uses it.

    Attributes
    ----------
    light
        (height, width) float32, the last picture.
    rate
        (height, width) float32, its derivative, per second; None where none is drawn.
    frames
        Pictures drawn so far.
    pixel_light
        The light of single pixels at any instant, for the refinement of undersampled steps; None where the scene cannot
        give it, or it is not wanted.
    """

    def __init__(self, scene: Scene, *, with_rate: bool, halving: bool = False) -> None:
        width, height = scene.size
        self.scene = scene
        self.light: Light = np.zeros((height, width), np.float32)
        with_rate = with_rate and scene.has_rate
        self.rate: Light | None = np.zeros((height, width), np.float32) if with_rate else None
        self.pixel_light: PixelLight | None = scene.pixel_light if with_rate and halving else None
        self.frames = 0

    @property
    def changed(self) -> Region | None:
        """The part of the last picture that may differ from the one before it; None: anything."""
        return self.scene.changed

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.scene.size

    def draw(self, t_ns: int) -> None:
        """Draw the picture of stream time `t_ns`."""
        if self.rate is None:
            self.scene.light(t_ns, self.light)
        else:
            self.scene.light_and_rate(t_ns, self.light, self.rate)
        self.frames += 1
