"""From what the elements of an IMU feel to the counts of its converters, as the host's registers ask.

    motion at 1 kHz -> low-pass -> every n-th sample -> rounded to whole counts, cut at 16 bits

The low-pass is Butterworth's with two poles; the data sheet gives only bandwidths and delays. With the drivers' default
white noise gets a correlation from sample to sample of 0.72 for the gyroscope and 0.65 for the accelerometer; a real
DAVIS346 had 0.72 and 0.52. Its delay at low frequencies is 1.2 ms at 184 Hz; the data sheet tells 2.9 ms, so a part of
the real delay is left out. Settings act from the next sample on; a filter that is changed or switched on starts
settled.
"""

from __future__ import annotations

import math

import numpy as np
import numpy.typing as npt

from emulator.sensor.imu.gravity import STANDARD_GRAVITY_M_S2
from emulator.sensor.imu.motion import ImuMotion
from firmware_protocol.imu_samples import THERMOMETERS, ImuSamples, ImuScale, ImuSettings, no_samples

__all__ = ["Converter"]

_RATE_HZ = 1000.0

Floats = npt.NDArray[np.float64]


class Converter:
    """Filters and converters. Motion goes in, samples in counts come out."""

    def __init__(self) -> None:
        self._filter: _LowPass | None = None

    def stop(self) -> None:
        """Forget what the filter holds."""
        self._filter = None

    def samples(self, motion: ImuMotion, settings: ImuSettings) -> ImuSamples:
        """Return the samples that `motion`, (n,) IMU_MOTION in order, leads to, (m <= n,) IMU_SAMPLE."""
        samples = no_samples(len(motion))
        taken = np.zeros(len(motion), np.bool_)
        for k, one in enumerate(motion):
            felt = self._filtered(np.concatenate([one["force"], one["rate"]]), settings)
            taken[k] = settings.takes(int(one["index"]))
            if taken[k]:
                samples[k] = one["t"], settings.scale, _counts(felt, float(one["temperature"]), settings)
        return samples[taken]

    def _filtered(self, felt: Floats, settings: ImuSettings) -> Floats:
        bandwidths = settings.accelerometer_mhz / 1000, settings.gyroscope_mhz / 1000
        if self._filter is None or self._filter.bandwidths_hz != bandwidths:
            self._filter = _LowPass(bandwidths, felt)
        return self._filter.step(felt)


def _counts(felt: Floats, temperature_c: float, settings: ImuSettings) -> npt.NDArray[np.int16]:
    """Return the seven counts: accelerometer, temperature, gyroscope; 0 for what does not run."""
    scale, (per_degree, offset_c) = ImuScale.parse(settings.scale), THERMOMETERS[settings.unit]
    there = [scale.accelerometer] * 3 + [scale.temperature] + [scale.gyroscope] * 3
    counts = np.concatenate(
        [
            felt[:3] / STANDARD_GRAVITY_M_S2 / scale.acceleration_g,
            [(temperature_c - offset_c) * per_degree],
            np.degrees(felt[3:]) / scale.rate_deg_s,
        ]
    )
    return np.where(there, np.clip(np.rint(counts), -32768, 32767), 0).astype(np.int16)


class _LowPass:
    """A Butterworth low-pass of two poles for six signals at 1 kHz, settled at `start`; from half the rate on, nothing.

    Source: the bilinear transform with the corner kept (Oppenheim and Schafer, Discrete-Time Signal Processing, 7.1).
    """

    def __init__(self, bandwidths_hz: tuple[float, float], start: Floats) -> None:
        self.bandwidths_hz = bandwidths_hz
        b, a1, a2 = np.repeat([_coefficients(hz) for hz in bandwidths_hz], 3, axis=0).T
        self._b, self._a1, self._a2 = b, a1, a2
        bypassed = b == 1.0
        self._twice = np.where(bypassed, 0.0, 2.0)
        self._once = np.where(bypassed, 0.0, 1.0)
        self._s2 = (self._once * b - a2) * start
        self._s1 = (self._twice * b - a1) * start + self._s2

    def step(self, x: Floats) -> Floats:
        """Return what comes out as `x`, (6,), goes in."""
        y = self._b * x + self._s1
        self._s1 = self._twice * self._b * x - self._a1 * y + self._s2
        self._s2 = self._once * self._b * x - self._a2 * y
        return np.asarray(y)


def _coefficients(bandwidth_hz: float) -> tuple[float, float, float]:
    """Return b0 (b1 = 2 b0, b2 = b0), a1 and a2; (1, 0, 0) for what the rate cannot limit."""
    if bandwidth_hz >= _RATE_HZ / 2:
        return 1.0, 0.0, 0.0
    k = math.tan(math.pi * bandwidth_hz / _RATE_HZ)
    norm = 1 + math.sqrt(2) * k + k * k
    return k * k / norm, 2 * (k * k - 1) / norm, (1 - math.sqrt(2) * k + k * k) / norm
