"""NIST's measurement of latencies, repeated: its tables, its protocol on a simulated sensor, and its statistics.

The protocol: a red LED switches on and off in front of the bare sensor, half a second each. After each edge, until the
next one, the first event of the edge's polarity gives a pixel's latency: ON after the LED switches on, OFF after it
switches off. Noise before the true event counts. Nine regions of 11 x 11 pixels are measured, each alone; their pixels
are numbered by x + 10 y, so that some share a key, of which the first event counts. Statistics over a region are
taken per edge, then their mean over edges; the first cycle is left out.

Here the nine regions lie side by side in one array, 11 pixels high, so that the read-out has as many rows to pick as in
one region alone. Edges are jumps. The light comes from the unit of light of the sensor's preset.
"""

from __future__ import annotations

import csv
import dataclasses
import warnings
from dataclasses import dataclass
from functools import cache
from pathlib import Path

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.presets import IMX636_W_M2, PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events, Floats, Int64s
from firmware_protocol.gen31.device import SLOPES as GEN31_SLOPES
from firmware_protocol.prophesee.biases import BiasModel, BiasSlopes
from laboratory.validation.findings import Source

_DATA = Path(__file__).with_name("data")

NIST = Source(
    "NIST, pixel latency of event cameras",
    "doi 10.1109/tim.2025.3623767, github.com/usnistgov/pixel_latency_eventcameras",
    'Developed by the National Institute of Standards and Technology (NIST), which is acknowledged; provided "AS IS".',
    "digitised from the colour maps and charts of the repository; not NIST's own tables",
)

REGIONS, SIDE = 9, 11
HALF_PERIOD_US = 500_000
CYCLES = 5
_STEPS = 12  # of a half period: fewer would lose events of a pixel beyond 64 a step
_JUMP_NS = 100


Row = dict[str, float]
"""One row of a table, by the names of its columns."""

_SLOPES = {"imx636_nist": BiasSlopes(), "gen31_nist": GEN31_SLOPES}


@cache
def table(name: str) -> tuple[Row, ...]:
    """Return the rows of a table by its name, such as "nist_latency"; an empty cell is NaN."""
    with (_DATA / f"{name}.csv").open(newline="") as file:
        lines = csv.DictReader(line for line in file if not line.startswith("#"))
        return tuple({key: float(value or "nan") for key, value in line.items()} for line in lines)


def at_biases(p: SensorParameters, slopes: BiasSlopes, diff_on: int, diff_off: int) -> SensorParameters:
    """Return a sensor with biases that many steps from the factory's."""
    factors = BiasModel(slopes, has_delay=True).factors({"diff_on": diff_on, "diff_off": diff_off})
    delay = factors.pop("off_latency_us", 1.0)
    jitter = dataclasses.replace(p.jitter, off_latency_us=p.jitter.off_latency_us * delay)
    return dataclasses.replace(
        p, jitter=jitter, **{name: getattr(p, name) * factor for name, factor in factors.items()}
    )


@dataclass(frozen=True, slots=True)
class Edges:
    """Events around the edges of the LED's light: `on_us` and `off_us`, (cycles,), the edges' stream times."""

    events: Events
    on_us: Int64s
    off_us: Int64s

    def after(self, edge_us: int) -> Events:
        """Return the events from an edge to the next one."""
        first, last = np.searchsorted(self.events["t"], (edge_us, edge_us + HALF_PERIOD_US))
        return self.events[first:last]


def pulsed(p: SensorParameters, irradiance_w_m2: float, seed: int, cycles: int = CYCLES) -> Edges:
    """Return the events of a sensor in front of a lamp that is off, then on, for half a second each, in each cycle."""
    sensor = Sensor(p, seed)
    off, on = (np.full((p.height, p.width), light, np.float32) for light in (0.0, irradiance_w_m2 / IMX636_W_M2))
    sensor.reset(LightFrame(0, off))
    parts, t_ns, half_ns = [], 0, HALF_PERIOD_US * 1000
    for half in range(2 * cycles):
        light = on if half % 2 else off
        begin_ns = half * half_ns
        if half:
            parts.append(sensor.expose(LightFrame(begin_ns + _JUMP_NS, light)))
        for k in range(1, _STEPS + 1):
            t_ns = begin_ns + half_ns * k // _STEPS
            parts.append(sensor.expose(LightFrame(t_ns, light)))
    parts.append(sensor.finish())
    edges = np.arange(2 * cycles, dtype=np.int64) * HALF_PERIOD_US
    return Edges(np.concatenate(parts), edges[1::2], edges[2::2])


def regions(unit: str) -> SensorParameters:
    """Return the preset of one of NIST's cameras with the array of the nine regions."""
    return dataclasses.replace(PRESETS[unit], width=REGIONS * SIDE, height=SIDE)


def first_latencies(events: Events, edge_us: int, on: bool) -> Floats:
    """Return the latency of each pixel that has an event of a polarity, us, in the order of the pixels."""
    events = events[events["on"] == on]
    _, first = np.unique(events["y"].astype(np.int64) << 16 | events["x"], return_index=True)
    return np.asarray(events["t"][first].astype(np.int64) - edge_us, np.float64)


def _firsts(events: Events, edge_us: int, on: bool) -> list[Floats]:
    """Return the latency of each pixel key of each region that has an event of a polarity, us."""
    events = events[events["on"] == on]
    region, x = np.divmod(events["x"].astype(np.int64), SIDE)
    key = x + 10 * events["y"].astype(np.int64)
    _, first = np.unique(region * 1000 + key, return_index=True)
    late_us = events["t"][first].astype(np.int64) - edge_us
    return [late_us[region[first] == k].astype(np.float64) for k in range(REGIONS)]


@dataclass(frozen=True, slots=True)
class Statistics:
    """Statistics of the latency after edges of one polarity, us, as in NIST's table; `opposite` in pixel keys."""

    median_us: float
    least_us: float
    most_us: float
    mean_us: float
    responders: float
    opposite: float


def statistics(edges: Edges, on: bool) -> Statistics:
    """Return the statistics of latencies to ON or OFF events; the first cycle is left out."""
    per_region: list[Floats] = []
    for edge_us in (edges.on_us if on else edges.off_us)[1:]:
        after = edges.after(int(edge_us))
        own, other = _firsts(after, int(edge_us), on), _firsts(after, int(edge_us), not on)
        per_region.append(np.array([_of_region(one, opposite) for one, opposite in zip(own, other, strict=True)]))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", RuntimeWarning)  # regions of which no pixel responds stay NaN
        mean = np.nanmean(np.array(per_region), axis=0)  # over edges: (regions, figures)
        middle = np.nanmedian(mean, axis=0)
    return Statistics(*(float(value) for value in middle[:3]), *(float(value) for value in mean[:, 3:].mean(axis=0)))


def _of_region(own: Floats, opposite: Floats) -> tuple[float, ...]:
    if not own.size:
        return (np.nan, np.nan, np.nan, np.nan, 0.0, float(opposite.size))
    figures = np.median(own), own.min(), own.max(), own.mean()
    return (*(float(value) for value in figures), float(own.size), float(opposite.size))


@cache
def latencies(unit: str, irradiance_w_m2: float, biases: tuple[int, int], seed: int) -> tuple[Statistics, Statistics]:
    """Return the statistics of ON and of OFF events of a preset, at biases diff_on and diff_off."""
    edges = pulsed(at_biases(regions(unit), _SLOPES[unit], *biases), irradiance_w_m2, seed)
    return statistics(edges, True), statistics(edges, False)
