"""Parameters of a sensor, and the known sensors.

Light is relative to the sensor's reference level: 1.0 is the light at which `corner_hz_at_reference` holds. Thresholds
are in natural-log units of photocurrent.

Sources of the presets' values: *estimate* marks values without a source: such a value is not calibrated, is typical of
the family and is meant to be overridden by a rig. *one recording* marks values that were measured on one public
recording of one camera, in unknown light.

    parameter                  davis346                     dvxplorer_micro              imx636
    size                       346 x 260 [1]                640 x 480 [2]                1280 x 720 [3]
    thresholds, ln             0.283 / 0.262 [4]            0.25 / 0.25 estimate         0.223 / 0.223 [3], ln 1.25
    mismatch                   3.5 % [5]                    3.5 % estimate as [5]        3.5 % estimate as [5]
    dark current, relative     0.001 estimate               0.001 estimate               0.001 estimate
    corner at reference        3 kHz at 1 klux [6]          3 kHz estimate as [6]        3 kHz estimate as [6]
    corner, least and most     3 Hz / 3 kHz [6] [7]         3 Hz / 3 kHz as davis346     3 Hz / 3 kHz as davis346
    source follower            286 Hz [8]                   none: no value found         none: no value found
    leak and its spread        0.001 Hz [9], 30 % [10]      as davis346, estimate        0: see background
    parasitic leak             0.002 Hz at light 1 [9]      as davis346, estimate        0: see background
    noise, rms                 0.055 [11], uncertain        0: no value found            0.0445 [17]
    its pole, spread           286 Hz [8], none             none                         2.7 kHz, 22 % [17]
    background                 none: leak and noise         none                         0.0038 Hz, 22 % ON [12]
    refractory                 3.4 us [4]                   100 us estimate [13]         100 us estimate [13]
    read-out                   arbiter                      scan, 197.28 us [14]         arbiter
    time of an event           80 ns (12 Mev/s) [15]        2.2 ns (450 Mev/s) [16]      0.94 ns (1.06 Gev/s) [3]
    time of a row              80 ns estimate               none                         50 ns estimate

    [1] libcaer, DAVIS346: 346 x 260.
    [2] Every published client (libcaer, dv-processing) is built for 640 x 480 on both DVXplorers. A paper on PANGU's
        event sensor gives 640 x 400; no source was found for that.
    [3] Finateu et al., ISSCC 2020, 5.10, from memory: 1280 x 720, 1.066 Gev/s, nominal contrast 25 %.
    [4] jAER's formulas (it cites IEEE 7962235) with the bias words that all DAVIS346 drivers write by default:
        F ln(I_on/I_diff) with F = 0.0714; C V / I_refr with 20 fF, 0.8 V, 4.75 nA.
    [5] DAVIS240, Brandli et al., IEEE JSSC 2014, from memory.
    [6] Lichtsteiner, Posch and Delbruck, IEEE JSSC 2008: 3 kHz at 1 klux of scene light.
    [7] 1-20 Hz below 1 lux, in the same literature.
    [8] jAER's I / (2 pi U_T C1) with the DAVIS346's default bias. Signal and noise pass through it alike.
    [9] One recording (DAVIS346, a street, 2.36 s, shipped with the Python package aedat): still pixels fire at 0.0013,
        0.0020 and 0.0040 Hz where the frames are at 0-40, 40-120 and 120-170 of 255. The straight line through them,
        with level 80 taken as light 1, has about 0.001 Hz in the dark and 0.002 Hz a unit of light. Other chips and
        warmer ones leak at 0.1 to 0.2 Hz (Nozaki and Delbruck 2017, from memory; Guo and Delbruck, DND21).
    [10] v2e's usual spread of leak rates between pixels.
    [11] Fitted to recording [9]: its still half has 296 events, that of the preset 311. Uncertain in the dark: at
        levels 0 to 10 of its frames the real pixels fire at 0.0082 Hz, these less. Other DVS fire at about 10 Hz in dim
        light (Guo and Delbruck, DND21), which needs 0.086; 0.043 to 0.073 were measured at another chip's comparator
        (Graca 2024, fig. 2.13).
    [12] One recording (EVK4, 10.8 s), pixels of low activity: 0.0038 Hz, 22 % ON, 96.6 % of the pixels silent, 75 % of
        a pixel's successive events of opposite polarity, 12 pixels above 50 events.
    [13] Between the chips' few microseconds and the 0.5 ms of v2e; a bias sets it.
    [14] One recording (320 x 240, of a DVXplorer's kind): 97.6 % of a pixel's intervals are whole multiples of that.
        iniVation: about 5000 scans a second, fewer under load, stamps continuous during a scan.
    [15] iniVation's white paper: about 80 ns an event, 12 Mev/s.
    [16] iniVation's sheet of the DVXplorer Micro, from memory.
    [17] Fitted to NIST's camera 1 (column "opposite", `evstim validate`): pixels that fire against the edge within
        half a second at 0.006 to 0.4 W/m2. Uncertain in the dark, where that camera fires some ten times as often.

`ideal` is a pixel of the textbook in an array of the DAVIS346's size: threshold 0.2, no low-pass, leak, noise, mismatch
or refractory period, references at the first frame's level, a read-out that takes no time.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Literal

from emulator.sensor.parameters import (
    BackgroundParameters,
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    TemperatureParameters,
    check,
    check_finite,
)

__all__ = ["IMX636_W_M2", "PRESETS", "ReadoutParameters", "SensorParameters"]

_MOST_PIXELS = 1 << 29
_MOST_MISMATCH = 0.3


@dataclass(frozen=True, slots=True)
class ReadoutParameters:
    """The read-out: an arbiter that serves requests of rows, or a scan of the columns.

    Attributes
    ----------
    event_ns : time on the output bus of one event, ns; above 0, fractions allowed.
    row_ns : time of the arbiter to pick a row and latch its requests, ns; 0 allowed. A scan has no such time.
    scan_us : time of a scan of all columns without events, us; 0: an arbiter.
    """

    event_ns: float
    row_ns: int
    scan_us: float = 0.0

    def __post_init__(self) -> None:
        check(self, "event_ns", 0.001, 1e9)
        check(self, "row_ns", 0, 1e9)
        check(self, "scan_us", 0, 1e6)


@dataclass(frozen=True, slots=True)
class SensorParameters:
    """A sensor's size and physics.

    Attributes
    ----------
    width, height : pixels.
    threshold_on, threshold_off : contrast thresholds, natural-log units, both > 0.
    mismatch : standard deviation of a pixel's thresholds, as a fraction of the threshold; ON and OFF drawn apart, once.
    dark_current_relative : photocurrent in the dark over photocurrent at the reference light, > 0. It is physics: it
        sets how many events a step from black to white has.
    corner_hz_at_reference : corner frequency of the photoreceptor at light 1, Hz; proportional to photocurrent. `inf`
        means no low-pass at all.
    corner_min_hz, corner_max_hz : bounds on the corner frequency, Hz.
    leak_hz : mean rate of leak events (ON) of a pixel in still light, Hz.
    leak_spread : log-normal spread of that rate between pixels (standard deviation of its logarithm).
    parasitic_hz_at_reference : rate of leak events that light 1 adds by shining into the reset switch, Hz; proportional
        to photocurrent, the same for all pixels.
    source_follower_hz : corner frequency of a second, fixed pole behind the photoreceptor, Hz; 0: no such pole.
    refractory_us : refractory period after an event, us; at its end the reference is read anew.
    random_start : true: the first references lie below the first frame's level by random shares of the ON
        threshold, as in a sensor that has run for a while; else at that level.
    photoreceptor : "one_pole", the small-signal model; "large_signal", the law V' = K (i - e^V), which is the same for
        small signals, rises slowly from the dark and falls slowly into it (see `pixels.receptor`); "circuit" solves
        the circuit with a second pole that limits its slew as well, at many times the cost.
    readout : the read-out's times.
    temperature, defects, noise, background, jitter, imager, radiation : see `parameters`; all off, or without
        effect, by default.
    """

    width: int
    height: int
    threshold_on: float
    threshold_off: float
    mismatch: float = 0.035
    dark_current_relative: float = 0.001
    corner_hz_at_reference: float = 3000.0
    corner_min_hz: float = 3.0
    corner_max_hz: float = 3000.0
    leak_hz: float = 0.1
    leak_spread: float = 0.3
    parasitic_hz_at_reference: float = 0.0
    source_follower_hz: float = 0.0
    refractory_us: float = 0.0
    random_start: bool = True
    photoreceptor: Literal["one_pole", "large_signal", "circuit"] = "one_pole"
    readout: ReadoutParameters = field(default_factory=lambda: ReadoutParameters(event_ns=80.0, row_ns=80))
    temperature: TemperatureParameters = field(default_factory=TemperatureParameters)
    defects: DefectParameters = field(default_factory=DefectParameters)
    noise: NoiseParameters = field(default_factory=NoiseParameters)
    background: BackgroundParameters = field(default_factory=BackgroundParameters)
    jitter: JitterParameters = field(default_factory=JitterParameters)
    imager: ImagerParameters = field(default_factory=ImagerParameters)
    radiation: RadiationParameters = field(default_factory=RadiationParameters)

    def __post_init__(self) -> None:
        for name in ("width", "height"):
            check(self, name, 1, 65536)
        if self.width * self.height > _MOST_PIXELS:
            raise ValueError(f"width x height = {self.width * self.height}: at most {_MOST_PIXELS} pixels")
        for name in (
            "threshold_on",
            "threshold_off",
            "dark_current_relative",
            "corner_hz_at_reference",
            "corner_min_hz",
        ):
            check(self, name, 0, math.inf, above=True)
        check(self, "mismatch", 0, _MOST_MISMATCH)
        for name in ("leak_hz", "leak_spread", "parasitic_hz_at_reference", "source_follower_hz", "refractory_us"):
            check(self, name, 0, math.inf)
        check_finite(self, unbounded=("corner_hz_at_reference", "corner_max_hz"))
        check(self, "corner_max_hz", self.corner_min_hz, math.inf)
        self._check_photoreceptor()
        self._check_noise()
        for name in ("hot_pixels", "dead_pixels"):
            self._check_places(name)

    def _check_photoreceptor(self) -> None:
        if self.photoreceptor not in ("one_pole", "large_signal", "circuit"):
            raise ValueError(
                f"photoreceptor = {self.photoreceptor!r}: must be 'one_pole', 'large_signal' or 'circuit'"
            )
        if self.photoreceptor == "circuit" and math.isinf(max(self.corner_hz_at_reference, self.corner_max_hz)):
            raise ValueError('photoreceptor = "circuit": needs a finite corner_hz_at_reference and corner_max_hz')

    def _check_noise(self) -> None:
        unlimited = math.isinf(self.corner_max_hz) or math.isinf(self.corner_hz_at_reference)
        if self.noise.rms and unlimited and not (self.noise.corner_hz or self.source_follower_hz):
            raise ValueError(
                f"noise.rms = {self.noise.rms!r}: must be 0 where nothing limits the noise's bandwidth; give "
                "source_follower_hz, noise.corner_hz, or a finite corner_hz_at_reference and corner_max_hz"
            )

    def _check_places(self, name: str) -> None:
        for x, y in getattr(self.defects, name):
            if not (0 <= x < self.width and 0 <= y < self.height):
                raise ValueError(f"defects.{name}: [{x}, {y}] must lie within {self.width} x {self.height} pixels")


IMX636_W_M2 = 0.192
"""Irradiance on the chip at 680 nm that is light 1 of the preset imx636, W/m2."""

PRESETS: MappingProxyType[str, SensorParameters] = MappingProxyType(
    {
        "davis346": SensorParameters(
            width=346,
            height=260,
            threshold_on=0.283,
            threshold_off=0.262,
            leak_hz=0.001,
            parasitic_hz_at_reference=0.002,
            source_follower_hz=286.0,
            refractory_us=3.4,
            readout=ReadoutParameters(event_ns=80.0, row_ns=80),
            noise=NoiseParameters(rms=0.055, history_s=100.0),
        ),
        "dvxplorer_micro": SensorParameters(
            width=640,
            height=480,
            threshold_on=0.25,
            threshold_off=0.25,
            leak_hz=0.001,
            parasitic_hz_at_reference=0.002,
            refractory_us=100.0,
            readout=ReadoutParameters(event_ns=2.2, row_ns=0, scan_us=197.28),
        ),
        "imx636": SensorParameters(
            width=1280,
            height=720,
            threshold_on=0.223,
            threshold_off=0.223,
            mismatch=0.1,
            photoreceptor="large_signal",
            corner_max_hz=30_000.0,
            leak_hz=0.0,
            refractory_us=100.0,
            readout=ReadoutParameters(event_ns=0.33, row_ns=127),
            jitter=JitterParameters(latency_us=19.3, off_latency_us=23.6, late_share=0.0005, late_us=3000.0),
            noise=NoiseParameters(rms=0.0445, corner_hz=2700.0, spread=0.22, history_s=100.0),
            background=BackgroundParameters(
                hz=0.0033, off_share=0.84, pair_share=0.05, hot_share=1.3e-5, hot_hz=46.0, hot_pair_share=0.6
            ),
        ),
        "ideal": SensorParameters(
            width=346,
            height=260,
            threshold_on=0.2,
            threshold_off=0.2,
            mismatch=0.0,
            corner_hz_at_reference=math.inf,
            corner_max_hz=math.inf,
            leak_hz=0.0,
            leak_spread=0.0,
            random_start=False,
            readout=ReadoutParameters(event_ns=0.001, row_ns=0),
        ),
    }
)
"""Sensors by name; the module's first lines name the source of each value."""
