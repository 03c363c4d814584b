"""Published values of real sensors, each with its source and the way it was obtained.

    cited        stated in the source, or in a table of a source
    measured     read from a recording of a real camera
    from memory  known to be in the source, not looked up again: check before quoting

A value without a light or without a contrast is drawn as a line across the curve: no position was invented for it.
Sources give light on the scene, light on the chip, or neither; all are drawn on one axis, so a decade along it is open.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from laboratory.characterise.stimuli import FIGURE

_LICHTSTEINER = "Lichtsteiner, Posch and Delbruck, IEEE JSSC 2008, abstract"
_BRANDLI = "Brandli et al., IEEE JSSC 2014 (DAVIS240)"
_SCIDVS = "SciDVS, arXiv 2409.09648"
_NOZAKI = "Nozaki and Delbruck 2017"
_DND21 = "Guo and Delbruck, DND21"
_GRACA = "Graca 2024, thesis, fig. 2.13, through a public re-implementation"
_RECORDING = "DAVIS346 recording shipped with the Python package aedat 2.3.0; its activity filter may have been on"
_WHITE_PAPER = "iniVation white paper on the DAVIS346"


@dataclass(frozen=True, slots=True)
class Published:
    """A published value of a real sensor.

    Attributes
    ----------
    description : includes the value.
    curve : curve in which it is drawn, or `FIGURE` for a value in the table alone.
    x, y : its position or positions. No x: a horizontal line at y (two: a band). No y: a vertical line at x.
    source, how : source, and the way the value was obtained.
    series : the line to compare it with; "": all lines of the curve.
    tolerance : factor within which our value agrees; 0: no fair comparison is possible, `remark` gives the reason.
    remark : condition of the comparison.
    own : True: the presets use this source, so that agreement shows only that they follow it.
    """

    description: str
    curve: str
    x: tuple[float, ...]
    y: tuple[float, ...]
    source: str
    how: Literal["cited", "measured", "from memory"]
    series: str = ""
    tolerance: float = 1.25
    remark: str = ""
    own: bool = False


PUBLISHED: tuple[Published, ...] = (
    Published("mismatch 2.1 % of contrast", FIGURE, (), (0.021,), _LICHTSTEINER, "cited", "mismatch ON, share"),
    Published("mismatch 3.5 %", FIGURE, (), (0.035,), _BRANDLI, "from memory", "mismatch ON, share", own=True),
    Published(
        "least usual contrast 10 %, commercial",
        "s_curve_on",
        (0.0953,),
        (),
        _SCIDVS,
        "cited",
        tolerance=0,
        remark="a sensor at its most sensitive bias; ours has the default biases",
    ),
    Published(
        "least contrast 1.7 % at 0.7 lx and 18 Hz",
        "s_curve_on",
        (0.0169,),
        (),
        _SCIDVS,
        "cited",
        tolerance=0,
        remark="another pixel, made for faint contrast",
    ),
    Published(
        "about 0.1 Hz at room temperature",
        "leak_temperature",
        (20.0,),
        (0.1,),
        _NOZAKI,
        "from memory",
        "as configured",
        own=True,
    ),
    Published(
        "leak doubles every 8 to 10 K",
        FIGURE,
        (),
        (8.0, 10.0),
        _NOZAKI,
        "from memory",
        "leak doubles every, K",
        tolerance=1.02,
        own=True,
    ),
    Published(
        "about 0.2 Hz in bright light",
        "leak_light",
        (),
        (0.2,),
        _DND21,
        "cited",
        "as configured",
        remark="light not stated",
    ),
    Published(
        "0.0029 Hz, 0.0021 to 0.0039 from darker to lighter parts",
        "leak_light",
        (),
        (0.0021, 0.0039),
        _RECORDING,
        "measured",
        "as configured",
        remark="a lower bound, in 2.36 s of unknown light and temperature",
    ),
    Published(
        "about 10 Hz in dim light",
        "noise_light",
        (),
        (10.0,),
        _DND21,
        "cited",
        remark="thresholds and light not stated; compared with the most of any light",
    ),
    Published(
        "OFF events 2e-5 Hz in normal light",
        "noise_light",
        (),
        (2e-5,),
        _RECORDING,
        "measured",
        tolerance=0,
        remark="a few events in all; light unknown",
    ),
    Published(
        "noise 0.043 to 0.073 ln units rms",
        FIGURE,
        (),
        (0.043, 0.073),
        _GRACA,
        "cited",
        "noise swept, ln rms",
        tolerance=0,
        remark="given to the sensor here, from end to end; not measured",
    ),
    Published(
        "15 us at least, above 1 klux",
        "latency",
        (1.0,),
        (15.0,),
        _LICHTSTEINER,
        "cited",
        remark="contrast not stated, so compared with a range of contrasts; biases can make it ten times slower",
    ),
    Published(
        "3 us at best",
        "latency",
        (),
        (3.0,),
        _BRANDLI,
        "from memory",
        tolerance=0,
        remark="fast biases; ours stops at 3 kHz",
    ),
    Published(
        "below 1 ms, typical of a DAVIS346",
        "latency",
        (),
        (1000.0,),
        "paper on PANGU's event sensor, after iniVation",
        "cited",
        tolerance=0,
        remark="light not stated",
    ),
    Published("3 kHz at 1 klux", "bandwidth", (1.0,), (3000.0,), _LICHTSTEINER, "cited", own=True),
    Published(
        "18 Hz at 0.7 lx on the chip",
        "bandwidth",
        (0.7e-3,),
        (18.0,),
        _SCIDVS,
        "cited",
        tolerance=1.5,
        remark="another pixel, with a pre-amplifier; light on the chip, ours on the scene",
    ),
    Published(
        "1 to 20 Hz below 1 lux",
        "bandwidth",
        (0.5e-3, 1e-3),
        (1.0, 20.0),
        "the same literature",
        "from memory",
        tolerance=0,
        remark="drawn as a corner: light and value each a range",
    ),
    Published(
        "286 Hz, source follower at default biases",
        "bandwidth",
        (),
        (286.0,),
        "jAER's I / (2 pi U_T C1) with the DAVIS346's default bias",
        "cited",
        tolerance=0,
        remark="not in the preset: sensor.source_follower_hz = 286.0 selects it",
    ),
    Published("10 000 at once wait up to about 1 ms", "burst", (10_000.0,), (1000.0,), _WHITE_PAPER, "cited"),
    Published(
        "over 1 to 2 ms, worst case, 0.005 % of the array at once",
        "burst",
        (),
        (1000.0, 2000.0),
        "SPIE 13045-130450P",
        "cited",
        tolerance=0,
        remark="host and USB included as far as is known",
    ),
    Published("12 Mev/s", FIGURE, (), (12.0,), _WHITE_PAPER, "cited", "read-out, Mev/s", tolerance=1.1, own=True),
    Published(
        "dead time 0.5 ms, v2e's default",
        "flicker_rate",
        (),
        (2000.0,),
        "v2e's source",
        "cited",
        tolerance=0,
        remark="a simulator's default, not a sensor's figure",
    ),
)
"""All figures, curve by curve."""
