"""Table of a rig for the frames of a DAVIS346: `FrameParameters`, and `KickParameters` within it.

Sources of the defaults; DN are units of the 10-bit converter:

    line time, order of reads      one recording: rows read 35.25 us apart, 260 of them before and after the exposure
    noise of pixels, total         the same: 1.7 of 255 at middle level, here 2 DN of reading and the rest of photons
    noise of columns and rows      the same: 0.42 and 0.10 of 255
    fixed pattern of columns       the same: 2.2 of 255, mostly of period 2
    sensitivity, reset level, gain spread   estimate: a rig's own
    row kicks                      the same: see `row_kicks`

A module of its own: rigs are loaded without the kernels of the sensor.
"""

from __future__ import annotations

from dataclasses import dataclass, field

from emulator.sensor.checks import check, check_finite

__all__ = ["FrameParameters", "KickParameters"]


@dataclass(frozen=True, slots=True)
class KickParameters:
    """Disturbance of the event pixels of a line by its read: a value is added to their signal for a moment.

    Attributes
    ----------
    share : of the ON threshold that is added; 0: frames do not disturb events.
    signal_excess : excess of the value of signal reads over that of reset reads, as a share of `share`.
    spread : between pixels and reads, standard deviation, as a share of `share`.
    delay_us : mean time from the read to the events, exponential.
    """

    share: float = 0.10
    signal_excess: float = 0.024
    spread: float = 0.02
    delay_us: float = 26.0

    def __post_init__(self) -> None:
        check(self, "share", 0, 0.9)
        check(self, "signal_excess", -1, 1)
        check(self, "spread", 0, 0.3)
        check(self, "delay_us", 0, 1000)


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
