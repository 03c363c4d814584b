"""The bench: a small array of the sensor in front of ideal lamps, one for each pixel.

Between two frames the sensor interpolates the logarithm of the photocurrent along a straight line, so a ramp in it, a
triangular flicker and a jump (a ramp of 10 ns) are closed forms here, not samples.

A pixel starts at an unknown distance from its threshold, and the response to a step would depend on this distance as
well as on the threshold. So a bench can be `settled` first: log light rises slowly, and the lamp of each pixel stops
where that pixel's first event shows the position of its reference. This is done twice, the second time from a start
moved by the result of the first, so that all pixels stop at the same light.

A `Point` is a measured value of a curve, beside the value of the pixel's equations.
"""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.sensor.chip.defects import at_temperature
from emulator.sensor.noise.law import corner_hz
from emulator.sensor.presets import ReadoutParameters, SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import EVENT, Events, Floats, Int64s

_SIZE = 64, 48
_JUMP_NS = 10
_RAMP_STEPS = 64
_RAMP_FARTHEST = 1.02  # of the highest threshold that five deviations allow
_LEAST_STEP_NS = 100_000
_NS = 1e9


def on_the_bench(p: SensorParameters, size: tuple[int, int] = _SIZE) -> SensorParameters:
    """Return the sensor cut down to `size` = (width, height); defects given by place stay behind."""
    defects = dataclasses.replace(p.defects, hot_pixels=(), dead_pixels=())
    return dataclasses.replace(p, width=size[0], height=size[1], defects=defects)


def without_readout(p: SensorParameters) -> SensorParameters:
    """Return the sensor with a read-out that takes no time, so that only the pixel has an effect."""
    return dataclasses.replace(p, readout=ReadoutParameters(event_ns=0.001, row_ns=0))


def log_current(p: SensorParameters, light: npt.ArrayLike) -> Floats:
    """Return the logarithm of the photocurrent, dark current at the chip's temperature included."""
    return np.log(np.asarray(light, np.float64) + at_temperature(p).dark_current_relative)


def lags_s(p: SensorParameters, light: npt.ArrayLike) -> tuple[Floats, float]:
    """Return the time constants of the photoreceptor in a light and of the source follower; 0: no such pole."""
    first = 1 / (2 * np.pi * corner_hz(at_temperature(p), light))
    return np.asarray(first), 1 / (2 * math.pi * p.source_follower_hz) if p.source_follower_hz else 0.0


def lag_s(p: SensorParameters, light: npt.ArrayLike) -> Floats:
    """Return the lag of the filter behind a slow ramp: the sum of its time constants."""
    first, second = lags_s(p, light)
    return first + second


class Bench:
    """A sensor, its lamps and the events that it has sent.

    Parameters
    ----------
    parameters : the sensor, of the bench's size.
    light : scalar or (height, width), light at the start, on which the sensor is at rest.
    seed : keys all random numbers.

    Attributes
    ----------
    t_ns : stream time.
    light : (height, width) float64, light of each lamp, relative to the sensor's reference.
    """

    def __init__(self, parameters: SensorParameters, light: npt.ArrayLike, seed: int = 1) -> None:
        self.parameters = parameters
        self.sensor = Sensor(parameters, seed)
        self.t_ns = 0
        self.light = self._picture(light)
        self._sent: list[Events] = []
        self.sensor.reset(LightFrame(0, self.light.astype(np.float32)))

    def _picture(self, light: npt.ArrayLike) -> Floats:
        return np.broadcast_to(np.asarray(light, np.float64), (self.parameters.height, self.parameters.width))

    def ramp(self, light: npt.ArrayLike, for_ns: int) -> Events:
        """Ramp to another light in `for_ns`, log current on a straight line; return the events sent meanwhile."""
        self.t_ns += for_ns
        self.light = self._picture(light)
        events = self.sensor.expose(LightFrame(self.t_ns, self.light.astype(np.float32)))
        self._sent.append(events)
        return events

    def hold(self, for_ns: int, steps: int = 1) -> None:
        """Keep the light; in several steps where a pixel may send more than 64 events."""
        for _ in range(steps):
            self.ramp(self.light, for_ns // steps)

    def jump(self, light: npt.ArrayLike) -> int:
        """Change the light at once, at the next whole microsecond; return this time, us of stream time."""
        self.hold(-self.t_ns % 1000)
        at_us = self.t_ns // 1000
        self.ramp(light, _JUMP_NS)
        return at_us

    def sent(self) -> Events:
        """Return all events since the last call, (n,) EVENT."""
        events = np.concatenate([np.empty(0, EVENT), *self._sent])
        self._sent.clear()
        return events

    def finish(self) -> Events:
        """Return all events since the last call of `sent`, including those that wait in the sensor; the last call."""
        self._sent.append(self.sensor.finish())
        return self.sent()

    def pixel(self, events: Events) -> Int64s:
        """Return the number of each event's pixel, row * width + column."""
        return np.asarray(events["y"].astype(np.int64) * self.parameters.width + events["x"])


def settled(p: SensorParameters, light: float, seed: int = 1) -> Bench:
    """Return a bench in `light` whose pixels have their references at their light, with all events removed."""
    first = Bench(p, light, seed)
    rise = _settle(first) - log_current(p, light)
    start = np.exp(log_current(p, light) - rise) - at_temperature(p).dark_current_relative
    bench = Bench(p, np.maximum(start, 0), seed)
    _settle(bench)
    bench.sent()
    return bench


def _settle(bench: Bench) -> Floats:
    """Raise the light until every pixel has fired, each stopped where it did; return log currents, (height, width).

    A lamp continues to rise until its pixel has updated its reference, and then returns to the light of that instant.
    """
    p, start, begin_ns = bench.parameters, log_current(bench.parameters, bench.light), bench.t_ns
    step_ns = _ramp_step_ns(p, float(bench.light.mean()))
    rise = p.threshold_on * (1 + 5 * p.mismatch) * _RAMP_FARTHEST / _RAMP_STEPS
    seen, read_s = np.full(start.shape, np.inf), np.full(start.shape, np.inf)
    for k in range(1, _RAMP_STEPS + 4):
        known = read_s <= (bench.t_ns - begin_ns) / _NS
        goal = np.where(known, seen, start + rise * min(k, _RAMP_STEPS))
        events = bench.ramp(np.exp(goal) - at_temperature(p).dark_current_relative, step_ns)
        events = events[events["on"] & np.isinf(seen[events["y"], events["x"]])]
        x, y = events["x"], events["y"]
        read_s[y, x] = (events["t"] - p.jitter.latency_us + p.refractory_us) * 1e-6 - begin_ns / _NS
        lag = np.maximum(lag_s(p, bench.light[y, x]), 1e-12)
        seen[y, x] = start[y, x] + rise / step_ns * _NS * (read_s[y, x] + lag * np.expm1(-read_s[y, x] / lag))
    return np.where(np.isfinite(seen), seen, start + rise * _RAMP_STEPS)


def _ramp_step_ns(p: SensorParameters, light: float) -> int:
    """Return a step slow against every delay of a pixel, and against a read-out of all of them."""
    whole_s = 5e-9 * p.width * p.height * (p.readout.event_ns + p.readout.row_ns)
    pixel_s = max(float(lag_s(p, light)) / 2, 2e-6 * p.refractory_us, 2e-6 * p.jitter.latency_us)
    return max(_LEAST_STEP_NS, round(max(pixel_s, whole_s / _RAMP_STEPS) * _NS))


FIGURE = "figure"
"""The curve of points that are single values: named by their series, not drawn."""


@dataclass(frozen=True, slots=True)
class Point:
    """One measured value.

    Attributes
    ----------
    curve : a key of `CURVES`, or `FIGURE`.
    series : line of the curve.
    x, y : in the curve's units.
    low, high : spread between pixels or events, 5 % and 95 %; NaN: none.
    model : value of the equations; NaN: no closed form.
    """

    curve: str
    series: str
    x: float
    y: float
    low: float = math.nan
    high: float = math.nan
    model: float = math.nan


@dataclass(frozen=True, slots=True)
class Curve:
    """Layout of a curve: its title, its axes, the chart that contains it, and the least value that gets a mark."""

    chart: str
    title: str
    x_label: str
    y_label: str
    log_x: bool = True
    log_y: bool = True
    least: float = 0.0


_LIGHT = "light, klux of scene light (1: the reference)"
CURVES: dict[str, Curve] = {
    "s_curve_on": Curve("s_curve", "S-curve, ON", "contrast step, ln", "probability of an event", False, False),
    "s_curve_off": Curve("s_curve", "S-curve, OFF", "contrast step, ln", "probability of an event", False, False),
    "spread": Curve("spread", "Thresholds of the pixels", "threshold, ln", "pixels, share a bin", False, False),
    "leak_spread": Curve("spread", "Leak of the pixels", "leak rate, Hz", "pixels, share a bin", False, False),
    "leak_temperature": Curve("leak", "Leak against temperature", "chip, degrees C", "events a pixel, Hz", False),
    "leak_light": Curve("leak", "Leak against light", _LIGHT, "events a pixel, Hz"),
    "noise_light": Curve("noise", "Noise events against light", _LIGHT, "events a pixel, ON and OFF, Hz"),
    "latency": Curve("latency", "Latency of a step, one pixel alone", _LIGHT, "latency, us (bars 5 to 95 %)"),
    "bandwidth": Curve("latency", "Bandwidth by the latency", _LIGHT, "corner frequency, Hz"),
    "burst": Curve("latency", "Pixels that fire together", "pixels at once", "latest event after the first, us"),
    "flicker_events": Curve(
        "flicker", "Flicker of 10:1 (line: no more can be)", "flicker, Hz", "events a pixel and period", least=0.03
    ),
    "flicker_rate": Curve(
        "flicker", "The same at 1 klux, by dead time", "flicker, Hz", "events a pixel, Hz", least=5.0
    ),
}
"""All curves, chart by chart."""
