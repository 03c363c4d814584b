"""What a sensor is made of, and the sensors that we know.

Light is relative to the sensor's reference level: 1.0 is the light at which `corner_hz_at_reference` holds. Thresholds
are in natural-log units of photocurrent.

Where the presets' figures come from (*estimate* marks what no source gives; such a figure is typical of the
family and is meant to be overridden by a rig):

    figure                     davis346                     dvxplorer_micro              imx636
    size                       346 x 260 [1]                640 x 480 [2]                1280 x 720 [3]
    thresholds, ln             0.283 / 0.262 [4]            0.25 / 0.25 estimate         0.223 / 0.223 [3], ln 1.25
    mismatch                   3.5 % [5]                    3.5 % estimate as [5]        3.5 % estimate as [5]
    dark current, relative     0.001 estimate               0.001 estimate               0.001 estimate
    corner at reference        3 kHz at 1 klux [6]          3 kHz estimate as [6]        3 kHz estimate as [6]
    corner, least and most     3 Hz / 3 kHz [6] [7]         3 Hz / 3 kHz as davis346     3 Hz / 3 kHz as davis346
    leak and its spread        0.1 Hz, 30 % [8] [9]         as davis346                  as davis346
    parasitic leak             0: no figure found           0                            0
    refractory                 3.4 us [4]                   100 us estimate [10]         100 us estimate [10]
    time of an event           80 ns (12 Mev/s) [11]        2.2 ns (450 Mev/s) [12]      0.94 ns (1.06 Gev/s) [3]
    time of a row              80 ns estimate               50 ns estimate               50 ns estimate

    [1] libcaer, DAVIS346: 346 x 260.
    [2] Every published client (libcaer, dv-processing) is built for 640 x 480 on both DVXplorers. A paper on PANGU's
        event sensor says 640 x 400; no source was found for that.
    [3] Finateu et al., ISSCC 2020, 5.10, from memory: 1280 x 720, 1.066 Gev/s, nominal contrast 25 %.
    [4] jAER's formulas (it cites IEEE 7962235) with the bias words that all DAVIS346 drivers write by default:
        F ln(I_on/I_diff) with F = 0.0714; C V / I_refr with 20 fF, 0.8 V, 4.75 nA.
    [5] DAVIS240, Brandli et al., IEEE JSSC 2014, from memory.
    [6] Lichtsteiner, Posch and Delbruck, IEEE JSSC 2008: 3 kHz at 1 klux of scene light. With default biases the
        DAVIS346's source follower holds the corner at 286 Hz (jAER: I / (2 pi U_T C1)): `source_follower_hz = 286.0`
        asks for that pole, the presets leave it out.
    [7] 1-20 Hz below 1 lux, in the same literature.
    [8] Nozaki and Delbruck 2017 ("about 0.1 Hz at room temperature", from memory); 0.2 Hz in bright light, Guo and
        Delbruck, DND21.
    [9] v2e's usual spread of leak rates between pixels.
    [10] Between the chips' few microseconds and the 0.5 ms of v2e; a bias sets it.
    [11] iniVation's white paper: about 80 ns an event, 12 Mev/s.
    [12] iniVation's sheet of the DVXplorer Micro, from memory.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from types import MappingProxyType

from emulator.sensor.checks import check, check_finite
from emulator.sensor.effects import (
    DefectParameters,
    ImagerParameters,
    JitterParameters,
    NoiseParameters,
    RadiationParameters,
    TemperatureParameters,
)

__all__ = ["PRESETS", "ReadoutParameters", "SensorParameters"]

_MOST_PIXELS = 1 << 29
_MOST_MISMATCH = 0.3


@dataclass(frozen=True, slots=True)
class ReadoutParameters:
    """The arbiter's times.

    Attributes
    ----------
    event_ns : time on the output bus of one event, ns; above 0, fractions allowed.
    row_ns : time to pick a row and latch its requests, ns; 0 allowed.
    """

    event_ns: float
    row_ns: int

    def __post_init__(self) -> None:
        check(self, "event_ns", 0.001, 1e9)
        check(self, "row_ns", 0, 1e9)


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
    refractory_us : time after an event during which the pixel is blind, us; at its end the reference is read anew.
    readout : the arbiter's times.
    temperature, defects, noise, jitter, imager, radiation : see `effects`; all off or without effect by default.
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
    readout: ReadoutParameters = field(default_factory=lambda: ReadoutParameters(event_ns=80.0, row_ns=80))
    temperature: TemperatureParameters = field(default_factory=TemperatureParameters)
    defects: DefectParameters = field(default_factory=DefectParameters)
    noise: NoiseParameters = field(default_factory=NoiseParameters)
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
        for name in ("hot_pixels", "dead_pixels"):
            self._check_places(name)

    def _check_places(self, name: str) -> None:
        for x, y in getattr(self.defects, name):
            if not (0 <= x < self.width and 0 <= y < self.height):
                raise ValueError(f"defects.{name}: [{x}, {y}] must lie within {self.width} x {self.height} pixels")


PRESETS: MappingProxyType[str, SensorParameters] = MappingProxyType(
    {
        "davis346": SensorParameters(
            width=346,
            height=260,
            threshold_on=0.283,
            threshold_off=0.262,
            refractory_us=3.4,
            readout=ReadoutParameters(event_ns=80.0, row_ns=80),
        ),
        "dvxplorer_micro": SensorParameters(
            width=640,
            height=480,
            threshold_on=0.25,
            threshold_off=0.25,
            refractory_us=100.0,
            readout=ReadoutParameters(event_ns=2.2, row_ns=50),
        ),
        "imx636": SensorParameters(
            width=1280,
            height=720,
            threshold_on=0.223,
            threshold_off=0.223,
            refractory_us=100.0,
            readout=ReadoutParameters(event_ns=0.94, row_ns=50),
        ),
    }
)
"""Sensors by name; the module's first lines tell the source of each figure."""
