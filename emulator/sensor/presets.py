"""Parameters of a sensor, and the known sensors.

Light is relative to the sensor's reference level: 1.0 is the light at which `corner_hz_at_reference` holds. Thresholds
are in natural-log units of photocurrent. Leak and dark current are those at 20 degrees Celsius.

Sources of the values: *estimate* marks values without a source, not calibrated, typical of the family and meant to be
overridden by a rig; *one recording* values measured on one public recording of one camera, in unknown light.

    parameter                  davis346                     dvxplorer_micro              imx636_nist
    size                       346 x 260 [1]                640 x 480 [2]                1280 x 720 [3]
    thresholds, ln             0.283 / 0.262 [4]            0.25 / 0.25 estimate         0.2165 / 0.229 [3] [24]
    mismatch                   3.5 % [5]                    3.5 % estimate as [5]        8.5 % [24]
    temperature                20 degrees                   20 degrees                   45 degrees estimate [24]
    dark current, relative     0.001 estimate               0.001 estimate               0.00156, 0.0136 at 45 deg [24]
    photoreceptor              one pole                     one pole                     large signals [17]
    corner at reference        3 kHz at 1 klux [6]          3 kHz estimate as [6]        2.21 kHz at 0.1644 W/m2 [17]
    corner, least and most     3 Hz / 3 kHz [6] [7]         3 Hz / 3 kHz as davis346     3 Hz as davis346 / 30 kHz [17]
    source follower            286 Hz [8]                   none: no value found         4.15 kHz [17]
    leak and its spread        0.0007 Hz [9], 30 % [10]     0.001 Hz, 30 % estimate      none: at most 0.003 Hz [18]
    parasitic leak             0.0018 Hz at light 1 [9]     0.002 Hz estimate            none: no value found
    noise, rms                 0.01 [11]                    0.055 estimate [11]          0.0457 [24]
    its pole, spread           286 Hz [8], none             286 Hz as davis346, none     4.15 kHz [17], 7.5 % [24]
    its time before the start  100 s estimate               100 s estimate               100 s estimate
    background                 none: leak and noise         none                         as imx636_quiet, estimate
    refractory                 3.4 us [4]                   100 us estimate [13]         105 us estimate [18]
    read-out                   arbiter                      scan, 197.28 us [14]         arbiter
    time of an event           80 ns (12 Mev/s) [15]        2.2 ns (450 Mev/s) [16]      0.33 ns [19]
    time of a row              80 ns estimate               none                         127 ns [19]
    delay of an event          none                         none                         0.8 us ON, 2.5 us OFF [17]
    late events                none                         none                         0.05 % by 3 ms [20]

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
    [9] One recording (DAVIS346, a street, 2.36 s, shipped with the Python package aedat): the still half of its pixels,
        chosen by the frames alone, fires at 0.0012, 0.0013, 0.0018, 0.0024 and 0.0049 Hz where the frames are at 0-20,
        20-40, 40-80, 80-120 and 120-170 of 255, all ON. A straight line through them, with level 80 taken as light 1,
        has 0.0007 Hz in the dark and 0.0018 Hz a unit of light. Other chips and warmer ones leak at 0.1 to 0.2 Hz
        (Nozaki and Delbruck 2017, from memory; Guo and Delbruck, DND21).
    [10] v2e's usual spread of leak rates between pixels.
    [11] An upper bound by recording [9]. Its still pixels at level 0 to 10 have 0.0004 Hz, at most 0.0016 Hz (2 events
        of 1918 pixels, 95 %), which noise of 0.04 exceeds; leak carries references past the distances at which noise
        fires. And its events come with the row kicks of frames (share .98), before which noise must not fire: of 16
        values of `evstim validate davis346_street` at least 15 are alike with 0.0125 and less, for three seeds, 13 with
        0.015 and 0.02, 9 with 0.025, 7 with 0.03 and 6 with 0.055. Simulated kicks act on a signal without noise, so
        the bound by kicks may be too low. 0.043 to 0.073 were measured at another chip's comparator (Graca 2024, fig.
        2.13): hence the estimate for the DVXplorer, of which no recording shows its noise.
    [12] One recording (EVK4, 10.8 s, shipped with the sources of the Python package faery). In tiles of pixels that see
        no motion, 1.9 % of the pixels fire, 15 % of their events are ON; pixels of low activity near motion have twice
        that rate. OFF followed by ON after 1.26 s, ON by OFF after 2.6 s (medians); a tail of 1e-4 of the pixels with 5
        to 1447 events, half of them ON. Shares and waits of followers were fitted to the sequences, rate and share to
        the tiles; `evstim validate evk4_quiet` compares them.
    [13] Between the chips' few microseconds and the 0.5 ms of v2e; a bias sets it.
    [14] One recording (320 x 240, of a DVXplorer's kind): 97.6 % of a pixel's intervals are whole multiples of that.
        iniVation: about 5000 scans a second, fewer under load, stamps continuous during a scan.
    [15] iniVation's white paper: about 80 ns an event, 12 Mev/s.
    [16] iniVation's sheet of the DVXplorer Micro, from memory.

    [17] Fitted, with the noise on, to latencies that NIST measured on one camera of this family (doi
        10.1109/tim.2025.3623767; digitised, `evstim validate`), with a red LED of 680 nm, 0.006 to 0.4 W/m2 on the bare
        sensor, at seven pairs of biases. ON and OFF latencies follow light, and only the large-signal law has both.
        Only threshold over corner is determined: the threshold is [3]. No bound of the corner is seen; 30 kHz lies
        above all that was measured. In bright light latencies depend more on the threshold, and less on the light, than
        one pole allows: a second pole explains that. OFF events have a delay that rises exponentially with diff_off, to
        1.4 ms at 142, in any light: the comparator's, as its current falls. Its light 1 is `IMX636_W_M2`.
    [18] The refractory period is not determined; [25] has 79 us. At high thresholds 0.0 of 111 pixels have an ON event
        in half a second of dark, in each of ten rows: a leak of 0.006 Hz would give 0.13.
    [19] The same: mean latency over regions of 32 to 420 pixels' side, within 4.2 us for three seeds. Stamps are set
        before the output bus, of 1.06 Gev/s [3], limits.
    [20] An estimate: the same measurement has a few pixels that come milliseconds late.
    [24] Fitted together with [17] to the same camera (`evstim validate opposite latency`): 70 medians, and the pixels
        that fire against the edge within half a second, at 0.006 to 0.4 W/m2 and in the dark between. Only threshold
        over rms is determined: the mean threshold is [3]. The bandwidth of noise is that of the photoreceptor, so its
        rate in the dark gives the dark current there; the temperature is unknown: 45 degrees are an estimate, and the
        dark current at 20 follows from it. Pixels of one noise and one threshold lose events too fast as light and
        thresholds rise: hence mismatch and spread.
    [25] Noise2Params (Root, Mujo and Xu, arXiv 2605.16317): a model that was fitted to another EVK4.

Each other preset is another unit that was measured in public; `imx636` and `gen31` are the units `_nist`, defaults of
their camera models (docs/cameras.md has the reason). Values not named here are those of the unit that it copies:

    davis346_noisy       leak of 0.2 Hz; noise of 0.1, at most 10 Hz in dim light: as stated for that of DND21 [9]
    imx636_noise2params  [25], with its mismatch: noise, scale of light, leak of 0.0096 Hz at 45 degrees, a background
                         of 0.0318 Hz, all OFF, fitted to its rates at 13 lights (within a factor of 2, one lux taken
                         for 1.4 lx of sunlight) and to its floor of 0.041 Hz with 23 % ON
    imx636_quiet         [12]: no leak; noise of 0.032, an estimate: at most 0.003 Hz in any light, so that the
                         background is the recorded one in any light; 10 000 s, in which so rare noise settles
    gen31_nist           SilkyEvCam VGA of [17], at its biases, 138 and 132 mV from diff: thresholds, poles and delays
                         fitted to 18 medians (`evstim validate gen31`), deviation and late events to its fastest and
                         slowest pixels. Noise and leak have a bound alone: below 1 of 111 pixels fires against an edge
    gen31_moke           a recording through a Kerr microscope, its still tiles; not stored here. Estimates, with the
                         noise of imx636_noise2params and delays within [21], which its rates did not contradict

The chip of another camera of iniVation, `davis240c`: 240 x 180 pixels of 18.5 um [26]. Its drivers write the currents
of a DAVIS346 but for OffBn, which is 0; by [4], with half a step for 0 (an estimate), its thresholds are 0.283 and
0.311. Mismatch is [5]; all else is an estimate, as davis346, leak and noise of a quiet unit among it.

    [26] Brandli et al., IEEE JSSC 2014, from memory: 130 dB, least contrast 11 %, matching 3.5 %, least latency 3 us.
        Gallego et al. [21] have 12 us at 1 klux, a fill factor of 22 % and 12 Mev/s. These are the best settings of the
        biases, and the values here those of the drivers' default biases.

Sizes, read-outs and pitches of a Gen 3.1 are [21], of a GenX320, otherwise the pixels of imx636_nist, [22] and [23]:

    [21] Gallego et al., Event-based vision: a survey, IEEE TPAMI 2022, table 1 (Prophesee Gen3 CD), from memory: 15 um,
        fill factor 25 %, latency 40 to 200 us, least contrast 12 %, 66 Mev/s. The size is also in every client.
    [22] Prophesee's announcement of the GenX320 (October 2023), from memory: 320 x 320, 6.3 um, latency below 150 us at
        1 klux. The size is also in every client.
    [23] The most that the chip's own limit of its rate can be set to: 20000 events in 100 us (OpenEB).

`ideal` is a pixel of the textbook in an array of the DAVIS346's size: threshold 0.2, no low-pass, leak, noise, mismatch
or refractory period, references at the first frame's level, a read-out that takes no time.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Annotated, Literal

from msgspec import Meta

from emulator.sensor import parameters as effects
from firmware_protocol.bounds import Bounded, check_bounds

_MOST_PIXELS = 1 << 24  # 4096 x 4096: 3 GB of state; no event camera has as many

_Side = Annotated[int, Meta(ge=1, le=65536)]
_Threshold = Annotated[float, Meta(ge=1e-4, le=100)]
_Corner = Annotated[float, Meta(gt=0)]  # inf: no low-pass


@dataclass(frozen=True, slots=True)
class ReadoutParameters(Bounded):
    """The read-out: an arbiter that serves requests of rows, or a scan of the columns.

    Attributes
    ----------
    event_ns : time on the output bus of one event, ns.
    row_ns : time of the arbiter to pick a row and latch its requests, ns; not of a scan.
    scan_us : time of a scan of all columns without events, us; 0: an arbiter.
    """

    event_ns: Annotated[float, Meta(ge=0.001, le=1e9)]
    row_ns: Annotated[int, Meta(ge=0, le=10**9)]
    scan_us: Annotated[float, Meta(ge=0, le=1e6)] = 0.0


@dataclass(frozen=True, slots=True)
class SensorParameters:
    """A sensor's size and physics.

    Attributes
    ----------
    width, height : pixels.
    threshold_on, threshold_off : contrast thresholds, natural-log units.
    mismatch : standard deviation of a pixel's thresholds, as a fraction of the threshold; ON and OFF drawn apart, once.
    dark_current_relative : photocurrent in the dark over photocurrent at the reference light; it sets how many events a
        step from black to white has.
    corner_hz_at_reference : corner frequency of the photoreceptor at light 1, Hz; proportional to photocurrent. `inf`
        means no low-pass at all.
    corner_min_hz, corner_max_hz : bounds on the corner frequency, Hz.
    leak_hz : mean rate of leak events (ON) of a pixel in still light.
    leak_spread : log-normal spread of that rate between pixels.
    parasitic_hz_at_reference : rate of leak events that light 1 adds by shining into the reset switch, Hz; proportional
        to photocurrent, the same for all pixels.
    source_follower_hz : corner frequency of a second, fixed pole behind the photoreceptor, Hz; 0: no such pole.
    highpass_hz : corner frequency of a high-pass in front of the comparators, Hz; 0: none, else at least 0.01.
    refractory_us : refractory period after an event, us; at its end the reference is read anew.
    random_start : true: the first references lie random shares of the ON threshold below the first frame's level, as in
        a sensor that has run for a while; false: at that level.
    photoreceptor : "one_pole": the small-signal model; "large_signal": the law V' = K (i - e^V), slow from and into the
        dark (see `pixels.receptor`); "circuit": a second pole that limits the slew as well, at many times the cost.
    readout : the read-out's times.
    temperature, defects, noise, background, jitter, imager, radiation, comparator, reset : see `parameters`; all off,
        or without effect, by default.
    """

    width: _Side
    height: _Side
    threshold_on: _Threshold
    threshold_off: _Threshold
    mismatch: effects.Deviation = 0.035
    dark_current_relative: Annotated[float, Meta(ge=1e-30, le=1e6)] = 0.001
    corner_hz_at_reference: _Corner = 3000.0
    corner_min_hz: Annotated[float, Meta(gt=0, le=1e9)] = 3.0
    corner_max_hz: _Corner = 3000.0
    leak_hz: effects.Rate = 0.1
    leak_spread: effects.Spread = 0.3
    parasitic_hz_at_reference: effects.Rate = 0.0
    source_follower_hz: Annotated[float, Meta(ge=0, le=1e9)] = 0.0
    highpass_hz: Annotated[float, Meta(ge=0, le=1e5)] = 0.0
    refractory_us: Annotated[float, Meta(ge=0, le=1e7)] = 0.0
    random_start: bool = True
    photoreceptor: Literal["one_pole", "large_signal", "circuit"] = "one_pole"
    readout: ReadoutParameters = field(default_factory=lambda: ReadoutParameters(event_ns=80.0, row_ns=80))
    temperature: effects.TemperatureParameters = field(default_factory=effects.TemperatureParameters)
    defects: effects.DefectParameters = field(default_factory=effects.DefectParameters)
    noise: effects.NoiseParameters = field(default_factory=effects.NoiseParameters)
    background: effects.BackgroundParameters = field(default_factory=effects.BackgroundParameters)
    jitter: effects.JitterParameters = field(default_factory=effects.JitterParameters)
    imager: effects.ImagerParameters = field(default_factory=effects.ImagerParameters)
    radiation: effects.RadiationParameters = field(default_factory=effects.RadiationParameters)
    comparator: effects.ComparatorParameters = field(default_factory=effects.ComparatorParameters)
    reset: effects.ResetParameters = field(default_factory=effects.ResetParameters)

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.width * self.height > _MOST_PIXELS:
            raise ValueError(f"width x height = {self.width * self.height}: at most {_MOST_PIXELS} pixels")
        if not self.corner_max_hz >= self.corner_min_hz:
            raise ValueError(f"corner_max_hz must be at least corner_min_hz, got {self.corner_max_hz!r}")
        if 0 < self.highpass_hz < 0.01:
            raise ValueError(f"highpass_hz = {self.highpass_hz!r}: must be 0 (none) or at least 0.01")
        if self.photoreceptor not in ("one_pole", "large_signal", "circuit"):
            raise ValueError(f"photoreceptor = {self.photoreceptor!r}: must be 'one_pole', 'large_signal' or 'circuit'")
        if self.photoreceptor == "circuit" and math.isinf(max(self.corner_hz_at_reference, self.corner_max_hz)):
            raise ValueError('photoreceptor = "circuit": needs a finite corner_hz_at_reference and corner_max_hz')
        unlimited = math.isinf(self.corner_max_hz) or math.isinf(self.corner_hz_at_reference)
        if self.noise.rms and unlimited and not (self.noise.corner_hz or self.source_follower_hz):
            raise ValueError(
                f"noise.rms = {self.noise.rms!r}: must be 0 where nothing limits the noise's bandwidth; give "
                "source_follower_hz, noise.corner_hz, or a finite corner_hz_at_reference and corner_max_hz"
            )
        r, least = self.reset, min(self.threshold_on, self.threshold_off)
        if abs(r.offset) + 3 * r.noise > least / 2:
            raise ValueError(
                f"reset.offset = {r.offset!r}: it and three times reset.noise ({r.noise!r}) must be at most half of "
                f"the lower threshold, {least:g}; else a reset raises events by itself"
            )
        for name in ("hot_pixels", "dead_pixels"):
            for x, y in getattr(self.defects, name):
                if not (0 <= x < self.width and 0 <= y < self.height):
                    raise ValueError(f"defects.{name}: [{x}, {y}] must lie within {self.width} x {self.height} pixels")


IMX636_W_M2 = 0.1644
"""Irradiance on the chip at 680 nm that is light 1 of the presets of NIST's cameras, W/m2."""

_BACKGROUND = effects.BackgroundParameters(
    hz=0.0019, off_share=0.925, pair_share=0.036, on_pair_factor=4.0, again_share=0.4, pair_us=2_400_000.0,
    on_wait_factor=4.0, hot_share=1.1e-4, hot_hz=4.0, hot_spread=1.6, hot_pair_share=0.9,
)  # fmt: skip

_IMX636_NIST = SensorParameters(
    width=1280,
    height=720,
    threshold_on=0.2165,
    threshold_off=0.229,
    mismatch=0.085,
    dark_current_relative=0.00156,
    photoreceptor="large_signal",
    corner_hz_at_reference=2212.0,
    corner_max_hz=30_000.0,
    source_follower_hz=4150.0,
    leak_hz=0.0,
    refractory_us=105.0,
    readout=ReadoutParameters(event_ns=0.33, row_ns=127),
    temperature=effects.TemperatureParameters(celsius=45.0),
    jitter=effects.JitterParameters(latency_us=0.8, off_latency_us=2.5, late_share=0.0005, late_us=3000.0),
    noise=effects.NoiseParameters(rms=0.0457, spread=0.075, history_s=100.0),
    background=_BACKGROUND,
)

_IMX636_NOISE2PARAMS = dataclasses.replace(
    _IMX636_NIST,
    threshold_on=0.223,
    threshold_off=0.223,
    mismatch=0.043,
    dark_current_relative=0.0016,
    corner_hz_at_reference=2180.0,
    source_follower_hz=4050.0,
    leak_hz=0.0014,
    noise=effects.NoiseParameters(rms=0.0495, spread=0.01, history_s=100.0),
    background=dataclasses.replace(_BACKGROUND, hz=0.0318, off_share=1.0, pair_share=0.0),
)

_GEN31_NIST = dataclasses.replace(
    _IMX636_NIST,
    width=640,
    height=480,
    threshold_on=0.293,
    threshold_off=0.327,
    dark_current_relative=0.0016,
    corner_hz_at_reference=3550.0,
    source_follower_hz=4000.0,
    readout=ReadoutParameters(event_ns=15.2, row_ns=50),
    jitter=effects.JitterParameters(
        latency_us=341.0, deviation_us=45.0, off_latency_us=119.0, late_share=0.01, late_us=300.0
    ),
    noise=effects.NoiseParameters(rms=0.03, spread=0.01, history_s=10_000.0),
)

_DAVIS346 = SensorParameters(
    width=346,
    height=260,
    threshold_on=0.283,
    threshold_off=0.262,
    leak_hz=0.0007,
    parasitic_hz_at_reference=0.0018,
    source_follower_hz=286.0,
    refractory_us=3.4,
    readout=ReadoutParameters(event_ns=80.0, row_ns=80),
    noise=effects.NoiseParameters(rms=0.01, history_s=100.0),
)

PRESETS: MappingProxyType[str, SensorParameters] = MappingProxyType(
    {
        "davis346": _DAVIS346,
        "davis346_noisy": dataclasses.replace(
            _DAVIS346,
            leak_hz=0.2,
            parasitic_hz_at_reference=0.0,
            noise=effects.NoiseParameters(rms=0.1, history_s=100.0),
        ),
        "davis240c": dataclasses.replace(_DAVIS346, width=240, height=180, threshold_off=0.311),
        "dvxplorer_micro": SensorParameters(
            width=640,
            height=480,
            threshold_on=0.25,
            threshold_off=0.25,
            leak_hz=0.001,
            parasitic_hz_at_reference=0.002,
            refractory_us=100.0,
            readout=ReadoutParameters(event_ns=2.2, row_ns=0, scan_us=197.28),
            noise=effects.NoiseParameters(rms=0.055, corner_hz=286.0, history_s=100.0),
        ),
        "imx636": _IMX636_NIST,
        "imx636_nist": _IMX636_NIST,
        "imx636_noise2params": _IMX636_NOISE2PARAMS,
        "imx636_quiet": dataclasses.replace(
            _IMX636_NOISE2PARAMS,
            leak_hz=0.0,
            noise=effects.NoiseParameters(rms=0.032, spread=0.01, history_s=10_000.0),
            background=_BACKGROUND,
        ),
        "gen31": _GEN31_NIST,
        "gen31_nist": _GEN31_NIST,
        "gen31_moke": dataclasses.replace(
            _IMX636_NOISE2PARAMS,
            width=640,
            height=480,
            leak_hz=0.0009,
            corner_hz_at_reference=3000.0,
            readout=_GEN31_NIST.readout,
            jitter=effects.JitterParameters(latency_us=40.0, off_latency_us=180.0),
            background=dataclasses.replace(
                _BACKGROUND, hz=0.00334, off_share=0.83, pair_us=2_100_000.0, hot_share=1e-4
            ),
        ),
        "genx320": dataclasses.replace(
            _IMX636_NIST, width=320, height=320, readout=ReadoutParameters(event_ns=5.0, row_ns=50)
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
