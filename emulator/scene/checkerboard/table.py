"""Rig table of a moving checkerboard."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import ClassVar

from emulator.scene.kind import SceneKind

_BRIGHTEST = 1e9  # far above the range of any sensor, and safe in float32


@dataclass(frozen=True)
class CheckerboardParameters:
    """A moving checkerboard.

    Attributes
    ----------
    square_px : side of a square, pixels; at least 0.1.
    speed_px_s : speed of the board over the sensor, px/s, >= 0.
    direction_deg : direction of motion: 0 to the right, 90 down.
    rotation_deg : rotation of the board itself, clockwise in the light frame.
    bright, dark : light of the squares relative to the sensor's reference level, linear: 0 <= dark <= bright.
    """

    kind: ClassVar[str] = "checkerboard"
    square_px: float = 20.0
    speed_px_s: float = 200.0
    direction_deg: float = 0.0
    rotation_deg: float = 0.0
    bright: float = 1.0
    dark: float = 0.1

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if not math.isfinite(value):
                raise ValueError(f"{name} is {value}: it must be a finite number")
        if self.square_px < 0.1:
            raise ValueError(f"square_px is {self.square_px:g}: a square must be at least 0.1 px wide")
        if self.speed_px_s < 0:
            raise ValueError(f"speed_px_s is {self.speed_px_s:g}: give it >= 0 and turn direction_deg by 180 instead")
        if not 0 <= self.dark <= self.bright <= _BRIGHTEST:
            raise ValueError(
                f"dark is {self.dark:g} and bright is {self.bright:g}: 0 <= dark <= bright <= {_BRIGHTEST:g} must hold"
            )


CHECKERBOARD = SceneKind(CheckerboardParameters, "emulator.scene.checkerboard.checkerboard:Checkerboard")
