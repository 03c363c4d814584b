"""Arrays with noise in light that is a function of time, and the statistics of their events."""

import dataclasses
import math
from typing import NamedTuple

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.parameters import NoiseParameters
from emulator.sensor.pixels.array import PixelArray
from emulator.sensor.pixels.state import MEMORY, Field, put_field
from emulator.sensor.presets import SensorParameters

MS = 1_000_000
THRESHOLD = 0.223
QUANTILES = (0.05, 0.25, 0.5, 0.75, 0.95)


def one_pole(a, tau_s, apart=0.0, **changes):
    """A sensor without low-pass, whose noise has one pole; its thresholds are a deviations, ON `apart` farther."""
    noise = NoiseParameters(rms=THRESHOLD / a, corner_hz=1 / (2 * math.pi * tau_s))
    return plain(noise, apart, **{"corner_hz_at_reference": math.inf, "corner_max_hz": math.inf, **changes})


def two_poles(a, tau1_s, tau2_s, apart=0.0, **changes):
    """A sensor whose receptor has the same pole in any light, which signal and noise pass; the noise has another one.

    The rms behind both is `a` times less than the thresholds.
    """
    f = 1 / (2 * math.pi * tau1_s)
    noise = NoiseParameters(rms=THRESHOLD / a * math.sqrt(1 + tau2_s / tau1_s), corner_hz=1 / (2 * math.pi * tau2_s))
    return plain(noise, apart, **{"corner_hz_at_reference": f, "corner_min_hz": f, "corner_max_hz": f, **changes})


def plain(noise, apart=0.0, **changes):
    standard = {"width": 16, "height": 12, "mismatch": 0.0, "leak_hz": 0.0, "refractory_us": 20.0,
                "dark_current_relative": 1e-9}  # fmt: skip
    thresholds = {"threshold_on": THRESHOLD * (1 + apart / 2), "threshold_off": THRESHOLD * (1 - apart / 2)}
    return SensorParameters(noise=noise, **{**thresholds, **standard, **changes})


class Found(NamedTuple):
    """Events of an array, in the order of time, and the array."""

    t_ns: np.ndarray
    pixel: np.ndarray
    on: np.ndarray
    array: PixelArray

    def rows(self):
        return np.rec.fromarrays([self.t_ns, self.pixel, self.on])


def still(level=1.0):
    return lambda t_s: (level, 0.0)


def sine(amplitude, hz, phases=0.0):
    """Light e^(A sin(2 pi f t + phase))."""

    def light(t_s):
        angle = 2 * math.pi * hz * t_s + phases
        level = np.exp(amplitude * np.sin(angle))
        return level, level * amplitude * 2 * math.pi * hz * np.cos(angle)

    return light


def ramp(rate, level=1.0):
    return lambda t_s: (level * math.exp(rate * t_s), level * rate * math.exp(rate * t_s))


def frame(p, light, t_ns, **more):
    values = (np.full((p.height, p.width), 1.0) * np.reshape(v, (-1, 1) if np.ndim(v) == 0 else (p.height, p.width))
              for v in light(t_ns * 1e-9))  # fmt: skip
    level, rate = (np.ascontiguousarray(v, np.float32) for v in values)
    return LightFrame(int(t_ns), level, rate, **more)


def ends(step_ms, until_ms, begin_ms=0.0):
    """Ends of steps of one length, ns."""
    return range(round((begin_ms + step_ms) * MS), round(until_ms * MS) + 1, round(step_ms * MS))


def begun(p, light, begin_ns=0, seed=1, threads=1):
    array = PixelArray(p, seed, threads)
    array.reset(frame(p, light, begin_ns))
    return array


def run(array, light, ends_ns, after_step=None):
    """The events of an array that has begun."""
    parts = []
    for t_ns in ends_ns:
        step = array.step(frame(array.parameters, light, t_ns))
        parts.append((step.t_ns.copy(), step.pixel.astype(np.int64), step.on.copy()))
        if after_step is not None:
            after_step(array)
    return Found(*(np.concatenate(column) for column in zip(*parts, strict=True)), array)


def events_of(p, light, ends_ns, begin_ns=0, seed=1):
    return run(begun(p, light, begin_ns, seed), light, ends_ns)


def set_thresholds(array, on, off, scale):
    """Give each pixel its thresholds and its rms over that of the sensor."""
    put_field(array.state.fields, Field.ON, on)
    put_field(array.state.fields, Field.OFF, off)
    array.state.memory.reshape(-1, MEMORY)[: scale.size, 2] = scale


def set_references(array, references):
    """Give each pixel a reference; certificates are those of the ones before."""
    put_field(array.state.fields, Field.REFERENCE, references)
    forget_certificates(array)


def forget_certificates(array):
    put_field(array.state.fields, Field.UNTIL, np.full(array.parameters.width * array.parameters.height, -np.inf))
    array.wake()


class Statistics(NamedTuple):
    """Rate of a pixel and its relative standard error by the spread between pixels; successors; waits, s."""

    rate_hz: float
    error: float
    opposite: float
    waits_s: np.ndarray


def statistics_of(found, seconds):
    pixels = found.array.parameters.width * found.array.parameters.height
    counts = np.bincount(found.pixel, minlength=pixels)
    order = np.lexsort((found.t_ns, found.pixel))
    same = np.diff(found.pixel[order]) == 0
    error = counts.std() / math.sqrt(pixels) / counts.mean()
    opposite = np.diff(found.on[order].astype(np.int8))[same] != 0
    return Statistics(counts.mean() / seconds, error, opposite.mean(), np.diff(found.t_ns[order])[same] * 1e-9)


def without(p, *effects):
    """The sensor without noise."""
    return dataclasses.replace(p, noise=NoiseParameters(), **dict.fromkeys(effects, 0.0))
