"""The scenes of the chart, each with its sensor and the steps that it is swept over.

They are those of the tables by which the method was chosen: threshold 0.2 with 3 % mismatch, leak 0.1 Hz with 30 %
spread, contrast 10 : 1, corner frequency 300 Hz at light 1 and proportional to light between 1 and 3000 Hz, 60 pixels,
0.4 s.
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

from emulator.accuracy.harness import Case
from emulator.accuracy.light import (
    BlurredCheckerboard,
    Dark,
    DriftingStar,
    Flash,
    Flicker,
    MovingEdge,
    SineGrating,
    SlowRamp,
    TexturedDisc,
)
from emulator.accuracy.profiles import ShadedEdge, ThinLine, TurningBody
from emulator.sensor.presets import SensorParameters

__all__ = ["CASES", "PLAIN", "QUICK", "Swept"]

PLAIN = SensorParameters(
    width=60,
    height=1,
    threshold_on=0.2,
    threshold_off=0.2,
    mismatch=0.03,
    dark_current_relative=1e-4,
    corner_hz_at_reference=300.0,
    corner_min_hz=1.0,
    corner_max_hz=3000.0,
    leak_hz=0.1,
    leak_spread=0.3,
)
"""The sensor of the tables, one row."""


@dataclass(frozen=True)
class Swept:
    """A case, its description in a few words, and its steps, ms."""

    case: Case
    told: str
    steps_ms: tuple[float, ...]


_FAST = (0.1, 0.2, 0.5, 1.0, 2.0, 5.0, 10.0)
_SLOW = (1.0, 2.0, 5.0, 10.0, 20.0, 50.0)

CASES = (
    Swept(
        Case("sine", SineGrating(), dataclasses.replace(PLAIN, corner_hz_at_reference=200.0)),
        "sine grating, 5.7 : 1, 20 Hz",
        _FAST,
    ),
    Swept(Case("edge03", MovingEdge(sigma_px=0.3), PLAIN), "edge of 0.3 px, 100 px/s", _FAST),
    Swept(Case("edge1", MovingEdge(sigma_px=1.0), PLAIN), "edge of 1 px, 100 px/s", _FAST),
    Swept(Case("checkerboard", BlurredCheckerboard(), PLAIN), "checkerboard, 0.5 px blur, 100 px/s", _FAST),
    Swept(Case("disc", TexturedDisc(), PLAIN), "textured disc, 1 rad/s", (*_FAST[2:], 20.0)),
    Swept(Case("star", DriftingStar(), PLAIN), "star 200 : 1, 17 px/s", (*_FAST[2:], 20.0)),
    Swept(Case("flicker", Flicker(), PLAIN), "flicker of 50 % at 100 Hz", (0.05, *_FAST[:5])),
    Swept(Case("flash", Flash(), PLAIN, 0.1), "flash 100 : 1 at an unknown instant", _FAST),
    Swept(
        Case("lowlight", SineGrating(hz=2.0, mean=0.0525, modulation=0.905), PLAIN, 1.0),
        "low light: 2 Hz sine, corner 1.5 to 30 Hz",
        _SLOW,
    ),
    Swept(Case("ramp", SlowRamp(), PLAIN, 2.0), "slow ramps, 0.3 to 3 ln units a second", _SLOW),
    Swept(Case("kinked", ShadedEdge(), PLAIN, 0.35), "kinked edge of 0.6 px, shaded, 100 px/s", _FAST),
    Swept(Case("line", ThinLine(profile="blurred"), PLAIN, 0.35), "line of 1 px, 0.6 px blur, 100 px/s", _FAST),
    Swept(Case("body", TurningBody(), PLAIN, 0.6), "turning body, 6 : 1, 100 px/s", _FAST),
    Swept(Case("dark", Dark(), dataclasses.replace(PLAIN, leak_hz=2.0), 2.0), "dark: leak alone, 2 Hz", _SLOW),
)
"""All scenes of the chart."""

QUICK = tuple(
    Swept(swept.case, swept.told, (0.5, 2.0, 5.0))
    for swept in CASES
    if swept.case.name in ("sine", "checkerboard", "disc")
)
"""Three scenes in three steps."""
