"""Tables of a rig for the effects of a sensor, for its frames and for its inertial unit; plain values, without kernels.

Every effect of a sensor is off, or changes nothing, by default:

    effect         off when                                   implemented in
    temperature    it is 20 degrees Celsius                   chip.defects
    defects        shares are 0 and lists empty               chip.defects
    noise          rms is 0                                   passages
    background     rates are 0                                chip.sources
    jitter         latency, deviation and leak share are 0    chip.readout, chip.defects
    comparator     times are 0                                pixels.event_time
    reset          offset, noise are 0, at_acknowledge false  pixels.state, chip.readout, chip.scan
    imager         gains are 1, spreads 0, shot noise false   chip.imager
    radiation      flux and dose are 0                        chip.sources, chip.defects

Sources of the defaults of `FrameParameters`, a DAVIS346; DN are units of the 10-bit converter:

    line time, order of reads      one recording: rows read 35.25 us apart, 260 of them before and after the exposure
    noise of pixels, total         the same: 1.7 of 255 at middle level, here 2 DN of reading and the rest of photons
    noise of columns and rows      the same: 0.42 and 0.10 of 255
    fixed pattern of columns       the same: 2.2 of 255, mostly of period 2
    sensitivity, reset level, gain spread   estimate: a rig's own
    row kicks                      the same: see `row_kicks`

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
from dataclasses import dataclass, field
from typing import Annotated, Literal

from msgspec import Meta

from firmware_protocol.bounds import Bounded, Share, check_bounds

REFERENCE_CELSIUS = 20.0
"""Temperature at which the parameters of a sensor hold."""

Rate = Annotated[float, Meta(ge=0, le=10_000)]
"""Rate of one pixel, Hz."""

Spread = Annotated[float, Meta(ge=0, le=3)]
"""Standard deviation of a logarithm."""

Deviation = Annotated[float, Meta(ge=0, le=0.3)]
"""Standard deviation, as a share."""

_Latency = Annotated[float, Meta(ge=0, le=100_000)]
_Dose = Annotated[float, Meta(ge=0, le=1e4)]
_Efficiency = Annotated[float, Meta(gt=0, le=100)]
_Dn = Annotated[float, Meta(ge=0, le=200)]
_ReadUs = Annotated[float, Meta(ge=0, le=1000)]
_Density = Annotated[float, Meta(ge=0, le=1e6)]

LEAK_DOUBLES_EVERY_K, DARK_DOUBLES_EVERY_K = 9.0, 8.0
"""Rise in temperature that doubles the leak of a junction, and the dark current."""


@dataclass(frozen=True, slots=True)
class TemperatureParameters(Bounded):
    """The chip's temperature, and its effect on leak and dark current.

    The junction's leak doubles every 9 K (8 to 10 in Nozaki and Delbruck 2017), a photodiode's dark current every 8 K
    (Janesick, Photon Transfer, 2007; both from memory). Parasitic photocurrent does not depend on temperature.

    Attributes
    ----------
    celsius : temperature of the chip, degrees Celsius; `leak_hz`, `dark_current_relative` and `corner_min_hz` hold at
        20.
    """

    celsius: Annotated[float, Meta(ge=-200, le=200)] = REFERENCE_CELSIUS

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
class DefectParameters(Bounded):
    """Hot and dead pixels. A pixel that is both is dead.

    A hot pixel is one whose leak has its own rate; a dead one has thresholds that no light reaches (section 1, item 10,
    of the pixel's equations).

    Attributes
    ----------
    hot_share : share of the pixels that are hot, drawn pixel by pixel.
    hot_pixels : more of them by place, [x, y] each.
    hot_hz : median rate of a hot pixel, Hz.
    hot_spread : log-normal spread of that rate between hot pixels.
    dead_share : share of the pixels that are dead, drawn pixel by pixel.
    dead_pixels : more of them by place, [x, y] each.
    """

    hot_share: Share = 0.0
    hot_pixels: tuple[tuple[int, int], ...] = ()
    hot_hz: Rate = 20.0
    hot_spread: Spread = 1.0
    dead_share: Share = 0.0
    dead_pixels: tuple[tuple[int, int], ...] = ()


@dataclass(frozen=True, slots=True)
class NoiseParameters:
    """Temporal noise at the comparator: an event is the first passage of signal plus noise through a threshold.

    Attributes
    ----------
    rms : of the noise behind the photoreceptor, ln units; 0: none. Measured: 0.04 to 0.07 (Graca 2024, fig. 2.13).
    corner_hz : second pole of the noise, fixed; 0: the signal's, `source_follower_hz`. The first is that of the
        photoreceptor, of corner frequency f: behind both the variance is rms^2 corner / (corner + f).
    spread : log-normal spread of the rms between pixels, with the median `rms`: a few fire far more often than the
        others, as on real chips.
    history_s : longest time for which noise has acted before the start, in the first light. Without it, references at
        random phases make a burst of events, as after a reset of the whole chip. Not with "grid".
    grade : "passages": all pixels, by the hazard of a passage; "offsets": the same law of settled noise, drawn once a
        reset, without bursts, at about half of the cost; "grid": some thousand pixels, by a fine grid of time.
    """

    rms: Share = 0.0
    corner_hz: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    grade: Literal["passages", "offsets", "grid"] = "passages"
    spread: Share = 0.0
    history_s: Annotated[float, Meta(ge=0, le=10_000)] = 0.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if 0 < self.corner_hz < 1:
            raise ValueError(f"corner_hz = {self.corner_hz!r}: must be 0 (the signal's) or at least 1")
        if self.grade not in ("passages", "offsets", "grid"):
            raise ValueError(f"grade = {self.grade!r}: must be 'passages', 'offsets' or 'grid'")


@dataclass(frozen=True, slots=True)
class BackgroundParameters(Bounded):
    """Background activity as counted in a recording, for sensors whose leak and noise are not known separately.

    Events at a constant rate, in any light. A primary event may be followed by one of the other polarity, and that one
    by another, as when a level drifts over a threshold and back. A few pixels are hot and have a rate of their own.
    `evstim characterise --recording FILE --fit` measures these parameters.

    Attributes
    ----------
    hz : mean rate of events of a pixel that is not hot, followers included, Hz.
    spread : log-normal spread of that rate between pixels.
    off_share : share of OFF events among the primaries.
    pair_share : share of the primaries that are followed by an event of the other polarity.
    on_pair_factor : `pair_share` of ON primaries, over that of OFF primaries.
    again_share : share of the followers that are followed by another event, again of the other polarity.
    pair_us : mean time from an event to its follower, us; exponential; shorter in a hot pixel, whose own rate adds to
        that of its followers.
    on_wait_factor : that time after ON events, over that after OFF events.
    hot_share : share of the pixels that are hot, drawn pixel by pixel.
    hot_hz : mean rate of hot pixels, Hz.
    hot_spread : log-normal spread of that rate between them.
    hot_pair_share : `pair_share` of hot pixels.
    """

    hz: Rate = 0.0
    spread: Spread = 0.0
    off_share: Share = 0.5
    pair_share: Share = 0.0
    on_pair_factor: Annotated[float, Meta(ge=0, le=100)] = 1.0
    again_share: Annotated[float, Meta(ge=0, le=0.95)] = 0.0
    pair_us: Annotated[float, Meta(ge=1, le=10_000_000)] = 1000.0
    on_wait_factor: Annotated[float, Meta(ge=0.01, le=100)] = 1.0
    hot_share: Share = 0.0
    hot_hz: Rate = 0.0
    hot_spread: Spread = 0.0
    hot_pair_share: Share = 0.0


@dataclass(frozen=True, slots=True)
class JitterParameters:
    """Delay of an event after its crossing, and variation of the leak.

    Events of a pixel stay in order: an event that would overtake another leaves together with it.

    Attributes
    ----------
    latency_us : mean delay from crossing to request, us.
    deviation_us : standard deviation of that delay, us; log-normal, so it needs a latency; that of OFF events is the
        same, relative.
    leak_share : relative standard deviation of a pixel's leak from one stretch of 8.6 s (2^33 ns) to the next; normal,
        cut off at zero leak.
    off_latency_us : mean delay of OFF events, us; 0: as `latency_us`.
    late_share : share of the events that come late.
    late_us : mean further delay of those, us; exponential.
    """

    latency_us: _Latency = 0.0
    deviation_us: _Latency = 0.0
    leak_share: Share = 0.0
    off_latency_us: _Latency = 0.0
    late_share: Share = 0.0
    late_us: Annotated[float, Meta(ge=1, le=1_000_000)] = 1000.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.deviation_us > 0 and self.latency_us == 0:
            raise ValueError(f"deviation_us = {self.deviation_us!r}: must be 0 without a latency_us to vary")
        for name in ("off_latency_us", "late_share"):
            if getattr(self, name) > 0 and self.latency_us == 0:
                raise ValueError(f"{name} = {getattr(self, name)!r}: must be 0 without a latency_us")


@dataclass(frozen=True, slots=True)
class ComparatorParameters(Bounded):
    """Delay of the comparators, which depends on the slope of the signal and on the polarity; see `pixels.event_time`.

    No camera's times are published. An estimate for the DAVIS346 at its default biases: an output node of 10 fF swings
    by 1 V at the bias currents that its drivers set, 387 nA for ON and 0.19 nA for OFF, in 0.03 us and 53 us. The
    currents are libcaer's (github.com/ros-event-camera/libcaer, davis_common.h and davis.c): coarse 5 of 387.5 nA, fine
    255 of 255; coarse 4 of 48.437 nA, fine 1. Node and swing are not published.

    Attributes
    ----------
    on_us, off_us : time in which the bias current alone drives the comparator's output from one level to the other, us;
        0: no delay.
    contrast_per_e : change of log light that changes the current of the comparator's input transistor by a factor e;
        0.0714 is jAER's value for a DAVIS.
    """

    on_us: Annotated[float, Meta(ge=0, le=10_000)] = 0.0
    off_us: Annotated[float, Meta(ge=0, le=10_000)] = 0.0
    contrast_per_e: Annotated[float, Meta(ge=1e-3, le=10)] = 0.0714


@dataclass(frozen=True, slots=True)
class ResetParameters(Bounded):
    """Errors of the reset that follows an event, and its time.

    When the reset switch opens, its channel's charge and the thermal noise of the capacitor stay on the reference. The
    noise is sqrt(k T / C) over gain: 0.8 mV for the 6 fF of a DAVIS, over some 0.5 V for a factor e of light (gain 20),
    is 0.0017. Both are estimates: the offset depends on the layout, and the biases of a real camera cancel its mean.

    Attributes
    ----------
    offset : of the reference over the signal after a reset, ln units: above 0, OFF is nearer and ON farther away by
        that much. Limited to 0.9 of a pixel's thresholds.
    noise : standard deviation of that offset from one reset to the next, ln units; normal.
    at_acknowledge : true: a pixel is in reset until the read-out acknowledges its event, where the refractory period
        begins; false: it begins at the crossing.
    """

    offset: Annotated[float, Meta(ge=-1, le=1)] = 0.0
    noise: Share = 0.0
    at_acknowledge: bool = False


@dataclass(frozen=True, slots=True)
class ImagerParameters(Bounded):
    """Effects of any imager on light before it becomes a signal.

    Attributes
    ----------
    system_efficiency : share of the light that reaches the pixels, relative to the sensor's reference.
    quantum_efficiency : electrons for a photon, relative to the sensor's reference.
    prnu : photo-response non-uniformity: standard deviation of a pixel's gain.
    dcnu : dark current non-uniformity: log-normal spread between pixels; the mean stays.
    photon_shot_noise, dark_shot_noise : true: the counts of photoelectrons and of dark electrons have Poisson noise,
        its slow part; `noise.rms` holds the fast one.
    electrons_per_s_at_reference : photocurrent of a pixel at light 1; 2e8 is a DAVIS346 pixel (18.5 um, fill factor 22
        %, quantum efficiency 24 %) at 1 klux on the chip.
    shot_grid_us : time over which electrons are counted, us; between two counts the light follows a straight line.
    """

    system_efficiency: _Efficiency = 1.0
    quantum_efficiency: _Efficiency = 1.0
    prnu: Deviation = 0.0
    dcnu: Spread = 0.0
    photon_shot_noise: bool = False
    dark_shot_noise: bool = False
    electrons_per_s_at_reference: Annotated[float, Meta(ge=1, le=1e15)] = 2e8
    shot_grid_us: Annotated[int, Meta(ge=100, le=10_000_000)] = 8192


@dataclass(frozen=True, slots=True)
class RadiationParameters(Bounded):
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

    hits_per_cm2_s: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    pixel_pitch_um: Annotated[float, Meta(ge=0.5, le=1000)] = 18.5
    depth_um: Annotated[float, Meta(ge=0, le=1000)] = 10.0
    off_share: Share = 0.3
    recovery_us: Annotated[float, Meta(ge=1, le=1_000_000)] = 1000.0
    dose_krad: _Dose = 0.0
    dose_krad_per_day: _Dose = 0.0
    hot_share_per_krad: Share = 1e-3


@dataclass(frozen=True, slots=True)
class KickParameters(Bounded):
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

    share: Annotated[float, Meta(ge=0, le=0.9)] = 0.10
    signal_excess: Annotated[float, Meta(ge=-1, le=1)] = 0.024
    spread: Deviation = 0.02
    frame_spread: Deviation = 0.0007
    delay_us: _ReadUs = 35.0
    reset_lead_us: _ReadUs = 12.0
    signal_lead_us: _ReadUs = 28.0


@dataclass(frozen=True, slots=True)
class FrameParameters(Bounded):
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

    sensitivity_dn_ms: Annotated[float, Meta(gt=0, le=1e9)] = 100.0
    reset_dn: Annotated[float, Meta(ge=384, le=1023)] = 900.0  # hosts take lower reset reads for saturated pixels
    electrons_per_dn: Annotated[float, Meta(ge=0, le=1e6)] = 9.5
    read_noise_dn: _Dn = 2.0
    column_noise_dn: _Dn = 1.7
    row_noise_dn: _Dn = 0.4
    column_pattern_dn: _Dn = 8.0
    column_fixed_dn: _Dn = 3.7
    gain_spread: Deviation = 0.01
    line_us: Annotated[float, Meta(ge=1, le=1000)] = 35.25
    kicks: KickParameters = field(default_factory=KickParameters)


_Triple = tuple[float, float, float]


@dataclass(frozen=True)
class ImuParameters:
    """An inertial measurement unit.

    Attributes
    ----------
    unit : "mpu_9250", also for the MPU-6500 of a DAVIS346, "mpu_6050", or "bmi160" of a DVXplorer: its filters and its
        thermometer.
    q_camera_from_imu : rotation against the camera (x right, y down, z along the boresight): unit quaternion, scalar
        first.
    gravity_m_s2 : gravity in the world, the same everywhere. Without it and `gm_m3_s2`: the Moon's above a terrain, in
        -z; the central body's on an "orbit"; the Earth's, down in the image, for a camera without a path; else none.
    gm_m3_s2 : above 0: gravity of a point mass at the world's origin instead.
    gyroscope_noise_deg_s, accelerometer_noise_ug : noise density, one-sided, a root of hertz.
    gyroscope_walk_deg_s, accelerometer_walk_g : random walk of the bias, a root of second.
    gyroscope_bias_deg_s, accelerometer_bias_g : bias at the start; without it one is drawn from the seed, with a
        standard deviation of 0.4 deg/s and of 20 mg.
    temperature_c : temperature of the unit.
    clock_ppm : rate error of its own clock, positive when it runs too fast.
    """

    unit: Literal["mpu_9250", "mpu_6050", "bmi160"] = "mpu_9250"
    q_camera_from_imu: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    gravity_m_s2: _Triple | None = None
    gm_m3_s2: Annotated[float, Meta(ge=0, le=1e22)] = 0.0
    gyroscope_noise_deg_s: _Density = 0.007
    accelerometer_noise_ug: _Density = 160.0
    gyroscope_walk_deg_s: _Density = 2e-4
    accelerometer_walk_g: _Density = 1e-5
    gyroscope_bias_deg_s: _Triple | None = None
    accelerometer_bias_g: _Triple | None = None
    temperature_c: Annotated[float, Meta(ge=-60, le=125)] = 28.5
    clock_ppm: Annotated[float, Meta(ge=-50_000, le=50_000)] = 1500.0

    def __post_init__(self) -> None:
        check_bounds(self)
        for name in ("gravity_m_s2", "gyroscope_bias_deg_s", "accelerometer_bias_g", "q_camera_from_imu"):
            value = getattr(self, name)
            if value is not None and not all(abs(part) < 1e9 for part in value):  # NaN compares false
                raise ValueError(f"{name} = {value}: must be finite numbers")
        if abs(math.hypot(*self.q_camera_from_imu) - 1) >= 1e-3:
            raise ValueError(f"q_camera_from_imu = {self.q_camera_from_imu}: must be a unit quaternion (w, x, y, z)")
        if self.gravity_m_s2 is not None and self.gm_m3_s2:
            raise ValueError("gm_m3_s2: gravity is either gravity_m_s2 or that of a point mass, not both")
