"""Tables of a rig for the effects of a sensor, for its frames and for its inertial unit; plain values, without kernels.

Every effect of a sensor is off, or changes nothing, by default:

    effect         off when                                   implemented in
    temperature    it is 20 degrees Celsius                   chip.defects
    defects        shares are 0 and lists empty               chip.defects
    noise          rms is 0                                   noise.points, noise.grid
    background     rates are 0                                chip.sources
    jitter         latency, deviation and leak share are 0    chip.readout, chip.defects
    comparator     times are 0                                pixels.comparator
    reset          offset, noise are 0, at_acknowledge false  pixels.state, chip.readout, chip.scan
    imager         gains are 1, spreads 0, shot noise false   chip.imager
    radiation      flux and dose are 0                        chip.sources, chip.defects

Sources of the defaults of `FrameParameters`, a DAVIS346; DN are units of the 10-bit converter:

    line time, order of reads      one recording: rows read 35.25 us apart, 260 of them before and after the exposure
    noise of pixels, total         the same: 1.7 of 255 at middle level, here 2 DN of reading and the rest of photons
    noise of columns and rows      the same: 0.42 and 0.10 of 255
    fixed pattern of columns       the same: 2.2 of 255, mostly of period 2
    sensitivity, reset level, gain spread   estimate: a rig's own
    row kicks                      the same: see `aps.row_kicks`

Sources of the defaults of `ImuParameters`:

    noise density     0.007 deg/s, 160 ug a root of Hz   one recording of a DAVIS346: 0.10 deg/s and 2 to 3 mg rms
                                                         behind the filters that drivers select by default
    bias              0.4 deg/s, 20 mg (spreads)         the same: up to 0.74 deg/s of the gyroscope; 20 mg: an estimate
    walk of the bias  2e-4 deg/s, 1e-5 g a root of s     estimates: no source was found for this unit
    clock             1500 ppm fast                      the same: periods of 998 and 999 us
    temperature       28.5 C                             the same
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field, fields
from typing import Any, Literal

__all__ = [
    "DARK_DOUBLES_EVERY_K",
    "LEAK_DOUBLES_EVERY_K",
    "MOST_LATENCY_US",
    "REFERENCE_CELSIUS",
    "BackgroundParameters",
    "ComparatorParameters",
    "DefectParameters",
    "FrameParameters",
    "ImagerParameters",
    "ImuParameters",
    "JitterParameters",
    "KickParameters",
    "NoiseParameters",
    "RadiationParameters",
    "ResetParameters",
    "TemperatureParameters",
    "check",
    "check_finite",
]


def check(owner: Any, name: str, low: float, high: float = math.inf, *, above: bool = False) -> None:
    """Raise ValueError unless low <= owner.name <= high (low < with `above`); NaN is always refused.

    The message begins with `name = value`, so that the key of a rig is found.
    """
    value = getattr(owner, name)
    good = low < value <= high if above else low <= value <= high
    if not good:
        least = "above" if above else "at least"
        most = "" if math.isinf(high) else f" and at most {high:g}"
        raise ValueError(f"{name} = {value!r}: must be {least} {low:g}{most}")


def check_finite(owner: Any, unbounded: tuple[str, ...] = ()) -> None:
    """Raise ValueError if a field other than those in `unbounded` is infinite."""
    for one in fields(owner):
        value = getattr(owner, one.name)
        if isinstance(value, float) and math.isinf(value) and one.name not in unbounded:
            raise ValueError(f"{one.name} = {value!r}: must be finite")


REFERENCE_CELSIUS = 20.0
"""Temperature at which the parameters of a sensor hold."""

MOST_LATENCY_US = 100_000
"""Longest mean delay of an event."""

LEAK_DOUBLES_EVERY_K, DARK_DOUBLES_EVERY_K = 9.0, 8.0
"""Rise in temperature that doubles the leak of a junction, and the dark current."""


@dataclass(frozen=True, slots=True)
class TemperatureParameters:
    """The chip's temperature, and its effect on leak and dark current.

    The junction's leak doubles every 9 K (8 to 10 in Nozaki and Delbruck 2017), a photodiode's dark current every 8 K
    (Janesick, Photon Transfer, 2007; both from memory). Parasitic photocurrent does not depend on temperature.

    Attributes
    ----------
    celsius : temperature of the chip, degrees Celsius; `leak_hz`, `dark_current_relative` and `corner_min_hz` hold at
        20.
    """

    celsius: float = REFERENCE_CELSIUS

    def __post_init__(self) -> None:
        check(self, "celsius", -200, 200)

    @property
    def warmer_k(self) -> float:
        """Difference to the reference temperature, K."""
        return self.celsius - REFERENCE_CELSIUS

    @property
    def leak_factor(self) -> float:
        """Leak over that at the reference temperature."""
        return float(2 ** (self.warmer_k / LEAK_DOUBLES_EVERY_K))

    @property
    def dark_factor(self) -> float:
        """Dark current over that at the reference temperature."""
        return float(2 ** (self.warmer_k / DARK_DOUBLES_EVERY_K))


@dataclass(frozen=True, slots=True)
class DefectParameters:
    """Hot and dead pixels. A pixel that is both is dead.

    A hot pixel is one whose leak has its own rate; a dead one has thresholds that no light reaches (section 1, item 10,
    of the pixel's equations).

    Attributes
    ----------
    hot_share : share of the pixels that are hot, drawn pixel by pixel.
    hot_pixels : more of them by place, [x, y] each.
    hot_hz : median rate of a hot pixel, Hz.
    hot_spread : log-normal spread of that rate between hot pixels (standard deviation of its logarithm).
    dead_share : share of the pixels that are dead, drawn pixel by pixel.
    dead_pixels : more of them by place, [x, y] each.
    """

    hot_share: float = 0.0
    hot_pixels: tuple[tuple[int, int], ...] = ()
    hot_hz: float = 20.0
    hot_spread: float = 1.0
    dead_share: float = 0.0
    dead_pixels: tuple[tuple[int, int], ...] = ()

    def __post_init__(self) -> None:
        for name in ("hot_share", "dead_share"):
            check(self, name, 0, 1)
        check(self, "hot_hz", 0, 10_000)
        check(self, "hot_spread", 0, 3)


@dataclass(frozen=True, slots=True)
class NoiseParameters:
    """Temporal noise at the comparator: a voltage with one pole whose excursions over a threshold are events.

    Attributes
    ----------
    rms : of the noise in dim light, natural-log units; 0: none. Measured: 0.04 to 0.07 (Graca 2024, fig. 2.13).
    corner_hz : fixed pole behind the photoreceptor, Hz; 0: the signal's, `source_follower_hz`, so that signal and noise
        have the same bandwidth (without a source follower noise passes the photoreceptor alone). Where the
        photoreceptor, of corner frequency f, is faster, the pole takes the noise down to rms^2 corner / (corner + f),
        its bandwidth to f corner / (corner + f).
    spread : log-normal spread of the rms between pixels (standard deviation of its logarithm; the median is `rms`): a
        few pixels fire far more often than the others, as on real chips.
    history_s : longest time for which noise has acted before the start, s, in the first light; each pixel takes as much
        of it as its level needs to settle. Without it, references at random phases make a burst of events, as after a
        reset of the whole chip. Points only.
    grade : "points" draws noise events by their rate, at a cost that follows their number; "grid" follows the voltage
        of each pixel on a fine grid of time, for sensors of some thousand pixels and for comparison.
    """

    rms: float = 0.0
    corner_hz: float = 0.0
    grade: Literal["points", "grid"] = "points"
    spread: float = 0.0
    history_s: float = 0.0

    def __post_init__(self) -> None:
        check(self, "rms", 0, 1)
        check(self, "history_s", 0, 10_000)
        check(self, "spread", 0, 1)
        check(self, "corner_hz", 0, 1e6)
        if 0 < self.corner_hz < 1:
            raise ValueError(f"corner_hz = {self.corner_hz!r}: must be 0 (the signal's) or at least 1")
        if self.grade not in ("points", "grid"):
            raise ValueError(f"grade = {self.grade!r}: must be 'points' or 'grid'")


@dataclass(frozen=True, slots=True)
class BackgroundParameters:
    """Background activity as counted in a recording, for sensors whose leak and noise are not known separately.

    Events at a constant rate, in any light. A primary event may be followed by one of the other polarity, and that one
    by another, as when a level drifts over a threshold and back. A few pixels are hot and have a rate of their own.
    `evstim characterise --recording FILE --fit` measures these parameters.

    Attributes
    ----------
    hz : mean rate of events of a pixel that is not hot, followers included, Hz.
    spread : log-normal spread of that rate between pixels (standard deviation of its logarithm).
    off_share : share of OFF events among the primaries.
    pair_share : share of the primaries that are followed by an event of the other polarity.
    on_pair_factor : `pair_share` of ON primaries, over that of OFF primaries.
    again_share : share of the followers that are followed by another event, again of the other polarity.
    pair_us : mean time from an event to its follower, us; exponential. That of a hot pixel is shorter: the rate of its
        followers is higher by its own rate.
    on_wait_factor : that time after ON events, over that after OFF events.
    hot_share : share of the pixels that are hot, drawn pixel by pixel.
    hot_hz : mean rate of hot pixels, Hz.
    hot_spread : log-normal spread of that rate between them (standard deviation of its logarithm).
    hot_pair_share : `pair_share` of hot pixels.
    """

    hz: float = 0.0
    spread: float = 0.0
    off_share: float = 0.5
    pair_share: float = 0.0
    on_pair_factor: float = 1.0
    again_share: float = 0.0
    pair_us: float = 1000.0
    on_wait_factor: float = 1.0
    hot_share: float = 0.0
    hot_hz: float = 0.0
    hot_spread: float = 0.0
    hot_pair_share: float = 0.0

    def __post_init__(self) -> None:
        for name in ("hz", "hot_hz"):
            check(self, name, 0, 10_000)
        for name in ("spread", "hot_spread"):
            check(self, name, 0, 3)
        for name in ("off_share", "pair_share", "hot_share", "hot_pair_share"):
            check(self, name, 0, 1)
        check(self, "again_share", 0, 0.95)
        check(self, "on_pair_factor", 0, 100)
        check(self, "on_wait_factor", 0.01, 100)
        check(self, "pair_us", 1, 10_000_000)


@dataclass(frozen=True, slots=True)
class JitterParameters:
    """Delay of an event after its crossing, and variation of the leak.

    Events of a pixel stay in order: an event that would overtake another leaves together with it.

    Attributes
    ----------
    latency_us : mean delay from crossing to request, us.
    deviation_us : standard deviation of that delay, us; delays are log-normal, so a deviation needs a latency. Delays
        of OFF events have the same relative deviation.
    leak_share : relative standard deviation of a pixel's leak from one stretch of 8.6 s (2^33 ns) to the next, so
        about that of the time between two leak events at 0.1 Hz; normal, cut off at zero leak.
    off_latency_us : mean delay of OFF events, us; 0: as `latency_us`.
    late_share : share of the events that come late.
    late_us : mean further delay of those, us; exponential.
    """

    latency_us: float = 0.0
    deviation_us: float = 0.0
    leak_share: float = 0.0
    off_latency_us: float = 0.0
    late_share: float = 0.0
    late_us: float = 1000.0

    def __post_init__(self) -> None:
        for name in ("latency_us", "off_latency_us", "deviation_us"):
            check(self, name, 0, MOST_LATENCY_US)
        check(self, "late_us", 1, 1_000_000)
        for name in ("late_share", "leak_share"):
            check(self, name, 0, 1)
        if self.deviation_us > 0 and self.latency_us == 0:
            raise ValueError(f"deviation_us = {self.deviation_us!r}: must be 0 without a latency_us to vary")
        for name in ("off_latency_us", "late_share"):
            if getattr(self, name) > 0 and self.latency_us == 0:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be 0 without a latency_us")


@dataclass(frozen=True, slots=True)
class ComparatorParameters:
    """Delay of the comparators, which depends on the slope of the signal and on the polarity; see `pixels.comparator`.

    No camera's times are published. An estimate for the DAVIS346 at its default biases: an output node of 10 fF swings
    by 1 V at the bias currents that its drivers set, 387 nA for ON and 0.19 nA for OFF, in 0.03 us and 53 us. The
    currents are libcaer's (github.com/ros-event-camera/libcaer, davis_common.h and davis.c): coarse 5 of 387.5 nA, fine
    255 of 255; coarse 4 of 48.437 nA, fine 1. Node and swing are not published.

    Attributes
    ----------
    on_us, off_us : time in which the bias current alone drives the output of the ON or OFF comparator from one level to
        the other, us; 0: no delay.
    contrast_per_e : change of log light that changes the current of the comparator's input transistor by a factor e; of
        the thresholds, theta = contrast_per_e ln(I_on / I_diff). 0.0714 is jAER's value for a DAVIS.
    """

    on_us: float = 0.0
    off_us: float = 0.0
    contrast_per_e: float = 0.0714

    def __post_init__(self) -> None:
        check(self, "on_us", 0, 10_000)
        check(self, "off_us", 0, 10_000)
        check(self, "contrast_per_e", 1e-3, 10)


@dataclass(frozen=True, slots=True)
class ResetParameters:
    """Errors of the reset that follows an event, and its time.

    When the reset switch opens, its channel's charge and the thermal noise of the capacitor stay on the reference. The
    noise is sqrt(k T / C) over gain: 0.8 mV for the 6 fF of a DAVIS, over some 0.5 V for a factor e of light (gain 20),
    is 0.0017. Both are estimates: the offset depends on the layout, and the biases of a real camera cancel its mean.

    Attributes
    ----------
    offset : of the reference over the signal after a reset, ln units. A positive one brings OFF nearer and takes ON
        farther away, by the same amount. Limited to 0.9 of a pixel's thresholds.
    noise : standard deviation of that offset from one reset to the next, ln units; normal.
    at_acknowledge : true: a pixel is in reset until the read-out acknowledges its event, and the refractory period
        begins there; false: it begins at the crossing.
    """

    offset: float = 0.0
    noise: float = 0.0
    at_acknowledge: bool = False

    def __post_init__(self) -> None:
        check(self, "offset", -1, 1)
        check(self, "noise", 0, 1)


@dataclass(frozen=True, slots=True)
class ImagerParameters:
    """Effects of any imager on light before it becomes a signal.

    Attributes
    ----------
    system_efficiency : share of the light that reaches the pixels, relative to the sensor's reference.
    quantum_efficiency : electrons for a photon, relative to the sensor's reference.
    prnu : photo-response non-uniformity: standard deviation of a pixel's gain.
    dcnu : dark current non-uniformity: log-normal spread between pixels (standard deviation of the logarithm); the mean
        stays.
    photon_shot_noise, dark_shot_noise : true: the counts of photoelectrons and of dark electrons have Poisson noise.
        `noise.rms` holds the fast part of both already; this is the slow part, which no filter removes.
    electrons_per_s_at_reference : photocurrent of a pixel at light 1, electrons a second. 2e8 is a DAVIS346 pixel
        (18.5 um, fill factor 22 %, quantum efficiency 24 %) at 1 klux on the chip.
    shot_grid_us : time over which electrons are counted, us; between two counts the light follows a straight line.
    """

    system_efficiency: float = 1.0
    quantum_efficiency: float = 1.0
    prnu: float = 0.0
    dcnu: float = 0.0
    photon_shot_noise: bool = False
    dark_shot_noise: bool = False
    electrons_per_s_at_reference: float = 2e8
    shot_grid_us: int = 8192

    def __post_init__(self) -> None:
        for name in ("system_efficiency", "quantum_efficiency"):
            check(self, name, 0, 100, above=True)
        check(self, "prnu", 0, 0.3)
        check(self, "dcnu", 0, 3)
        check(self, "electrons_per_s_at_reference", 1, 1e15)
        check(self, "shot_grid_us", 100, 10_000_000)


@dataclass(frozen=True, slots=True)
class RadiationParameters:
    """Particles that cross the chip, and lasting effects of a dose.

    A particle raises ON events along a straight track, at once, and OFF events at a share of its pixels while the
    charge drains. Isotropic flux: the cosine of the angle to the chip's normal, squared, is uniform; the track is as
    long as the sensitive layer is deep, times its tangent. Seen in beams: bursts and short tracks, quick recovery
    (neutrons, Roffe et al., arXiv 2102.00112); background activity rising with dose, a DAVIS346 failing between 20 and
    50 krad(Si) (McReynolds et al., "Automated characterization techniques and testbeds for event-based cameras").
    Depth, OFF share, recovery and hot pixels a krad are estimates.

    Attributes
    ----------
    hits_per_cm2_s : particles through the chip, per cm2 and second. In interplanetary space cosmic rays alone are some
        4 a cm2 and second (solar minimum; from memory).
    pixel_pitch_um : side of a pixel, um; the DAVIS346's.
    depth_um : depth of the layer that collects charge, um.
    off_share : share of the pixels of a track that also raise an OFF event.
    recovery_us : mean time from the ON event to the OFF event, us.
    dose_krad : dose taken when stream time is zero, krad(Si).
    dose_krad_per_day : dose taken in a day of stream time, krad(Si).
    hot_share_per_krad : share of the pixels that a krad makes hot; their rates are those of `defects`.
    """

    hits_per_cm2_s: float = 0.0
    pixel_pitch_um: float = 18.5
    depth_um: float = 10.0
    off_share: float = 0.3
    recovery_us: float = 1000.0
    dose_krad: float = 0.0
    dose_krad_per_day: float = 0.0
    hot_share_per_krad: float = 1e-3

    def __post_init__(self) -> None:
        check(self, "hits_per_cm2_s", 0, 1e6)
        check(self, "pixel_pitch_um", 0.5, 1000)
        check(self, "depth_um", 0, 1000)
        check(self, "off_share", 0, 1)
        check(self, "recovery_us", 1, 1_000_000)
        for name in ("dose_krad", "dose_krad_per_day"):
            check(self, name, 0, 1e4)
        check(self, "hot_share_per_krad", 0, 1)


@dataclass(frozen=True, slots=True)
class KickParameters:
    """Disturbance of the event pixels of a line by its read: a value is added to their signal for a moment.

    Attributes
    ----------
    share : of the ON threshold that is added; 0: frames do not disturb events.
    signal_excess : excess of the value of signal reads over that of reset reads, as a share of `share`.
    spread : between pixels and reads, standard deviation, as a share of `share`.
    frame_spread : between frames, for all pixels alike, standard deviation, as a share of `share`.
    delay_us : longest time from a kick to its events, that of pixels which need all of it, us.
    reset_lead_us, signal_lead_us : time from a kick to the reset or signal read that causes it, us; no kick comes
        before its frame begins.
    """

    share: float = 0.10
    signal_excess: float = 0.024
    spread: float = 0.02
    frame_spread: float = 0.0007
    delay_us: float = 35.0
    reset_lead_us: float = 12.0
    signal_lead_us: float = 28.0

    def __post_init__(self) -> None:
        check(self, "share", 0, 0.9)
        check(self, "signal_excess", -1, 1)
        check(self, "spread", 0, 0.3)
        check(self, "frame_spread", 0, 0.3)
        for name in ("delay_us", "reset_lead_us", "signal_lead_us"):
            check(self, name, 0, 1000)


@dataclass(frozen=True, slots=True)
class FrameParameters:
    """The active pixels. The host's registers hold the times and lengths of exposures.

    Attributes
    ----------
    sensitivity_dn_ms : brightness, DN, that light of 1.0 gives in an exposure of 1 ms.
    reset_dn : level of the reset read, DN; a pixel whose brightness reaches it is saturated, and hosts show it white.
    electrons_per_dn : sets the shot noise; 0: none.
    read_noise_dn : noise of a pixel's brightness in the dark, rms, DN.
    column_noise_dn, row_noise_dn : noise common to a column or a row, new in each frame, rms, DN.
    column_pattern_dn : fixed difference of every second column, half of it, DN.
    column_fixed_dn : fixed offset of each column beside that, rms, DN.
    gain_spread : between pixels, rms, as a share.
    line_us : time to read a line of 346 samples; shorter lines take less.
    kicks : disturbance of events by reading.
    """

    sensitivity_dn_ms: float = 100.0
    reset_dn: float = 900.0
    electrons_per_dn: float = 9.5
    read_noise_dn: float = 2.0
    column_noise_dn: float = 1.7
    row_noise_dn: float = 0.4
    column_pattern_dn: float = 8.0
    column_fixed_dn: float = 3.7
    gain_spread: float = 0.01
    line_us: float = 35.25
    kicks: KickParameters = field(default_factory=KickParameters)

    def __post_init__(self) -> None:
        check(self, "sensitivity_dn_ms", 0, above=True)
        check(self, "reset_dn", 384, 1023)  # hosts take lower reset reads for saturated pixels
        check(self, "electrons_per_dn", 0, 1e6)
        for name in ("read_noise_dn", "column_noise_dn", "row_noise_dn", "column_pattern_dn", "column_fixed_dn"):
            check(self, name, 0, 200)
        check(self, "gain_spread", 0, 0.3)
        check(self, "line_us", 1, 1000)
        check_finite(self)


_Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ImuParameters:
    """An inertial measurement unit.

    Attributes
    ----------
    unit
        "mpu_9250", also for the MPU-6500 of a DAVIS346, "mpu_6050", or "bmi160" of a DVXplorer: its filters and its
        thermometer.
    q_camera_from_imu
        Rotation against the camera (x right, y down, z along the boresight): unit quaternion, scalar first.
    gravity_m_s2
        Gravity in the world, the same everywhere. Without it, and without `gm_m3_s2`: that of the Moon above a terrain,
        straight down in -z; that of the central body of a path of kind "orbit"; that of the Earth, straight down in the
        image, where the camera has no path; else none.
    gm_m3_s2
        Above 0: gravity of a point mass at the world's origin instead.
    gyroscope_noise_deg_s, accelerometer_noise_ug
        Noise density, one-sided, a root of hertz.
    gyroscope_walk_deg_s, accelerometer_walk_g
        Random walk of the bias, a root of second.
    gyroscope_bias_deg_s, accelerometer_bias_g
        Bias at the start; without it one is drawn from the seed, with a standard deviation of 0.4 deg/s and of 20 mg.
    temperature_c
        Temperature of the unit.
    clock_ppm
        Rate error of its own clock, positive when it runs too fast.
    """

    unit: Literal["mpu_9250", "mpu_6050", "bmi160"] = "mpu_9250"
    q_camera_from_imu: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    gravity_m_s2: _Triple | None = None
    gm_m3_s2: float = 0.0
    gyroscope_noise_deg_s: float = 0.007
    accelerometer_noise_ug: float = 160.0
    gyroscope_walk_deg_s: float = 2e-4
    accelerometer_walk_g: float = 1e-5
    gyroscope_bias_deg_s: _Triple | None = None
    accelerometer_bias_g: _Triple | None = None
    temperature_c: float = 28.5
    clock_ppm: float = 1500.0

    def __post_init__(self) -> None:
        check_finite(self)
        for name in ("gravity_m_s2", "gyroscope_bias_deg_s", "accelerometer_bias_g", "q_camera_from_imu"):
            value = getattr(self, name)
            if value is not None and not all(abs(part) < 1e9 for part in value):  # NaN compares false
                raise ValueError(f"{name} = {value}: must be finite numbers")
        if abs(math.hypot(*self.q_camera_from_imu) - 1) >= 1e-3:
            raise ValueError(f"q_camera_from_imu = {self.q_camera_from_imu}: must be a unit quaternion (w, x, y, z)")
        if self.gravity_m_s2 is not None and self.gm_m3_s2:
            raise ValueError("gm_m3_s2: gravity is either gravity_m_s2 or that of a point mass, not both")
        for name in ("gyroscope_noise_deg_s", "accelerometer_noise_ug", "gyroscope_walk_deg_s", "accelerometer_walk_g"):
            check(self, name, 0.0, 1e6)
        check(self, "gm_m3_s2", 0.0)
        check(self, "temperature_c", -60, 125)
        check(self, "clock_ppm", -50_000, 50_000)
