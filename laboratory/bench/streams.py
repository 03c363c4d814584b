"""Shared by measurements: reproducible streams of events, a clock, a line of output, and the report of a failure.

`stars` and `target` are in closed form or nearly so, at the limits of a camera in space: pixels fire at each crossing
of a contrast threshold, at their exact microsecond, without read-out and refractory time. `davis_batches` has all that
a DAVIS346 sends: events of a saturated read-out, frames, inertial samples, marks.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from emulator.light import LightFrame
from emulator.rig.loading import load_rig
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.sensor.chip.readout import ArbiterReadOut
from emulator.sensor.pixels.array import PixelArray
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import EVENT, Events, Floats, Mask, empty_events
from firmware_protocol.frames import LineKind, line_record
from firmware_protocol.fx3.words import Block, Marks, Special, blocks_of, no_marks
from firmware_protocol.imu_samples import ImuSamples, no_samples


def saturated_stream(count: int, event_ns: int = 80, row_events: int = 8) -> Events:
    """Return the events of a saturated read-out: one every `event_ns`, `row_events` from each row that it serves.

    With the defaults 12.5 Mev/s. Rows follow each other as a round-robin arbiter takes them; columns are random.
    """
    rng = np.random.default_rng(346)
    index = np.arange(count)
    events = empty_events(count)
    events["t"] = index * event_ns // 1000
    events["x"] = rng.integers(0, 346, count)
    events["y"] = index // row_events * 3 % 260
    events["on"] = rng.integers(0, 2, count)
    return events


def scanned_stream(count: int, scan_us: float = 197.28, of_scan: int = 2000) -> Events:
    """Return the events of a scanned 640 x 480 read-out: `of_scan` random pixels a scan, column by column.

    With the defaults 10 Mev/s.
    """
    rng = np.random.default_rng(640)
    pixel = np.sort(rng.integers(0, 640 * 480, (-(-count // of_scan), of_scan)), axis=1).ravel()[:count]
    events = empty_events(count)
    events["x"], events["y"] = pixel // 480, pixel % 480
    events["t"] = (np.arange(count) // of_scan + events["x"] / 640) * scan_us
    events["on"] = rng.integers(0, 2, count)
    return events


def checkerboard_stream(count: int) -> Events:
    """Return the first `count` events of the shipped checkerboard rig, as its read-out sends them."""
    rig = load_rig("checkerboard")
    if not isinstance(rig.scene, CheckerboardParameters):
        raise TypeError("the shipped checkerboard rig has no checkerboard")
    sensor = rig.camera.sensor
    scene = Checkerboard(rig.scene, (sensor.width, sensor.height))
    pixels, readout = PixelArray(sensor, rig.run.seed), ArbiterReadOut(sensor)
    light = np.zeros((sensor.height, sensor.width), np.float32)
    scene.light(0, light)
    pixels.reset(LightFrame(0, light))
    batches, filled, t_ns = [], 0, 0
    while filled < count:
        t_ns += rig.run.step_us * 1000
        scene.light(t_ns, light)
        batches.append(readout.push(pixels.step(LightFrame(t_ns, light)), t_ns).copy())
        filled += len(batches[-1])
    return np.concatenate(batches)[:count]


SIZE = (346, 260)
_THRESHOLD = 0.2  # ln units

_Batch = tuple[Floats, Floats, Floats, Mask]
"""t in s, x, y, on, (n,) each."""


def _events(batches: list[_Batch]) -> Events:
    """Return the batches as one stream."""
    t, x, y, on = (np.concatenate(column) for column in zip(*batches, strict=True))
    events = np.zeros(len(t), EVENT)
    events["t"], events["x"], events["y"], events["on"] = t * 1e6, x, y, on
    return events[np.argsort(events["t"], kind="stable")]


def stars(duration_s: float) -> Events:
    """Return 0.34 Mev/s: 120 stars that drift at 60 px/s over a dark sky, and noise of 0.5 Hz a pixel."""
    rng = np.random.default_rng(120)
    width, height = SIZE
    noise = rng.poisson(0.5 * width * height * duration_s)
    batches = [_noise(rng, noise, duration_s)]
    for _ in range(120):
        at = rng.uniform(0, width), rng.uniform(0, height)
        batches += _star(at, 10 ** rng.uniform(-0.3, 1.15), duration_s)
    return _events(batches)


def _noise(rng: np.random.Generator, count: int, duration_s: float) -> _Batch:
    x, y = rng.integers(0, SIZE[0], count), rng.integers(0, SIZE[1], count)
    return rng.uniform(0, duration_s, count), x.astype(float), y.astype(float), rng.random(count) < 0.5


def _star(at: tuple[float, float], peak: float, duration_s: float) -> list[_Batch]:
    """Return the events of a star: a Gaussian spot of sigma 1 px and of `peak` times the sky, that starts at `at`.

    Where its centre comes nearer than r to a pixel, the light there passes the level that the spot has at r.
    """
    speed_px_s, (along_x, along_y) = 60.0, (np.cos(0.3), np.sin(0.3))
    extent = int(speed_px_s * duration_s) + 6
    x, y = (values.ravel() for values in np.meshgrid(*(np.floor(c) + np.arange(-extent, extent) for c in at)))
    inside = (x >= 0) & (x < SIZE[0]) & (y >= 0) & (y < SIZE[1])
    x, y = x[inside], y[inside]
    ahead = (x - at[0]) * along_x + (y - at[1]) * along_y
    across = (y - at[1]) * along_x - (x - at[0]) * along_y
    batches: list[_Batch] = []
    for level in range(1, int(np.log1p(peak) / _THRESHOLD) + 1):
        r_squared = -2 * np.log(np.expm1(level * _THRESHOLD) / peak)
        half = np.sqrt(np.maximum(r_squared - across**2, 0))
        for sign, on in ((-1, True), (1, False)):
            t = (ahead + sign * half) / speed_px_s
            fires = (across**2 < r_squared) & (t >= 0) & (t < duration_s)
            batches.append((t[fires], x[fires], y[fires], np.full(fires.sum(), on)))
    return batches


def target(duration_s: float) -> Events:
    """Return 7.5 Mev/s: a textured disc of 200 pixels, eight waves of about 12 pixels in log light, at 127 px/s."""
    rng = np.random.default_rng(2)
    step_s = 50e-6
    y, x = np.mgrid[: SIZE[1], : SIZE[0]].astype(float)
    disc = np.hypot(x - SIZE[0] / 2, y - SIZE[1] / 2) < 100
    x, y = x[disc], y[disc]
    waves = [(*rng.normal(0, 2 * np.pi / 12, 2), rng.uniform(0, 2 * np.pi)) for _ in range(8)]
    offset = rng.uniform(0, 1, len(x))  # level of each pixel at its last event

    def level(t: float) -> Floats:
        waves_now = (0.6 * np.sin(kx * (x - 122 * t) + ky * (y - 36 * t) + phase) for kx, ky, phase in waves)
        return np.asarray(sum(waves_now)) / _THRESHOLD + offset

    batches: list[_Batch] = []
    before = level(0.0)
    for k in range(round(duration_s / step_s)):
        after = level((k + 1) * step_s)
        for on in (True, False):
            fires = np.floor(after) > np.floor(before) if on else np.floor(after) < np.floor(before)
            passed = np.floor(after if on else before)[fires]
            share = (passed - before[fires]) / (after - before)[fires]
            batches.append(((k + share) * step_s, x[fires], y[fires], np.full(fires.sum(), on)))
        before = after
    return _events(batches)


_FRAME_US, _LINE_US, _SAMPLE_US = 40_000, 26, 1000
_COLUMNS, _ROWS = 346, 260


@dataclass(frozen=True)
class DavisBatch:
    """Items of one stretch of stream time; all sorted by their times, us."""

    events: Events
    marks: Marks
    lines: Readings
    samples: ImuSamples

    @property
    def until_us(self) -> int:
        """Time of the last event."""
        return int(self.events["t"][-1])

    def blocks(self) -> list[Block]:
        """Return lines and samples as blocks in time order."""
        both = [*blocks_of(ReadingKind.FRAMES, self.lines), *blocks_of(ReadingKind.IMU, self.samples)]
        return sorted(both, key=lambda block: block.t_us)


def davis_batches(events: int, batch: int) -> list[DavisBatch]:
    """Return `events` events in batches of `batch`, with a frame each 40 ms, a sample and an edge each millisecond."""
    stream = saturated_stream(events)
    end_us = int(stream["t"][-1]) + 1
    lines = np.concatenate([_frame(start_us) for start_us in range(10, end_us, _FRAME_US)])
    samples, marks = no_samples(end_us // _SAMPLE_US), no_marks(end_us // _SAMPLE_US)
    samples["t"], samples["scale"] = _SAMPLE_US * np.arange(len(samples)) + 999, 0xE5
    samples["counts"] = np.random.default_rng(346).integers(-500, 500, (len(samples), 7))
    marks["t"], marks["code"] = _SAMPLE_US * np.arange(len(marks)) + 500, int(Special.INPUT_RISING)
    edges = [int(stream["t"][at]) for at in range(batch, len(stream), batch)]
    cuts = [_cut(part, edges) for part in (stream, marks, lines, samples)]
    return [DavisBatch(*parts) for parts in zip(*cuts, strict=True)]


def _cut(part: Readings, edges_us: list[int]) -> list[Readings]:
    return np.split(part, np.searchsorted(part["t"], edges_us))


def _frame(start_us: int) -> Readings:
    kinds = [LineKind.START, *[LineKind.RESET] * _COLUMNS, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END]
    kinds += [*[LineKind.SIGNAL] * _COLUMNS, LineKind.END]
    lines = np.zeros(len(kinds), line_record(_COLUMNS))
    lines["t"], lines["kind"] = start_us + _LINE_US * np.arange(len(kinds)), kinds
    lines["exposure"], lines["global_shutter"], lines["roi"] = 120_000, True, (0, 0, _COLUMNS - 1, _ROWS - 1)
    of_pixels = np.isin(lines["kind"], (LineKind.RESET, LineKind.SIGNAL))
    lines["length"][of_pixels] = _ROWS
    lines["samples"] = np.random.default_rng(346).integers(400, 1000, lines["samples"].shape)
    return lines


class BenchFailed(Exception):
    """The measured part gave a wrong result, so its speed is not reported."""


def processor_time_s(work: Callable[[], object]) -> float:
    """Return the processor time of one call, s, of all threads."""
    start_s = time.process_time()
    work()
    return time.process_time() - start_s


def say(text: str) -> None:
    """Print a line at once."""
    sys.stdout.write(f"{text}\n")
    sys.stdout.flush()
