"""A recording beside the simulated sensor: statistics of both streams and their distances, and a fit of the sensor.

`fit` gives the parameters of `[camera.sensor]` that match the statistics of a recording of a still scene best. Where
nearly all events are ON and none alternate, they are leak: its rate, and its spread from the pixels' counts. Otherwise
they are background activity (`BackgroundParameters`). With p the ON share of primaries, s the share that is followed by
a second event, S = p^2 + (1 - p)^2 and D = 1 - S:

    hot pixels      those beyond what the others' counts allow once in a hundred recordings
    followers       opposite successors less those by chance, over primaries: within `_PAIRED_S`, where most are, or at
                    any time; chance then has D / S times the same successors, and followers after the end of the
                    recording are added
    s               followers over primaries
    p               from the ON share of all, (p + s (1 - p)) / (1 + s)
    s of hot ones   from the share of opposite successors, (s + s S + (1 - s) D) / (1 + s)
    spread          from the variance of the counts beyond that of pairs at one rate
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import optimize, stats
from scipy.ndimage import uniform_filter

from emulator.light import LightFrame
from emulator.playback.recording import read_events, read_frames
from emulator.report.page import Page, write_csv, write_json
from emulator.sensor.presets import SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import Events, Floats, Int64s, Mask
from laboratory.characterise.still_light import REFERENCE_DN, StillLight, still_events, still_light

_MOST_INTERVALS = 200_000
_NEIGHBOURHOOD = 5

_Bools = Mask


@dataclass(frozen=True)
class Activity:
    """Statistics of the events of some pixels.

    Attributes
    ----------
    seconds, pixels, events : extent of the stream, and numbers of counted pixels and events.
    on_share : share of ON events; NaN without events, as the other shares.
    silent_share : share of the pixels without any event.
    opposite_share : share of a pixel's successive events that differ in polarity.
    fano : variance of the pixels' counts over their mean.
    above_50 : pixels with more than 50 events.
    counts : (pixels,) events of each pixel.
    intervals_s : (n,) times between successive events of a pixel, s.
    opposite : (n,) bool, True for intervals between events of different polarity.
    per_ms, per_10_ms : events in each such stretch of time.
    """

    seconds: float
    pixels: int
    events: int
    on_share: float
    silent_share: float
    opposite_share: float
    fano: float
    above_50: int
    counts: Int64s
    intervals_s: Floats
    opposite: _Bools
    per_ms: Int64s
    per_10_ms: Int64s

    @property
    def rate_hz(self) -> float:
        """Mean rate of a pixel, Hz."""
        return self.events / (self.pixels * self.seconds)

    def figures(self) -> dict[str, float]:
        """Return the single figures, by name."""
        return {
            "rate, Hz a pixel": self.rate_hz,
            "ON share": self.on_share,
            "silent share": self.silent_share,
            "successive events of opposite polarity": self.opposite_share,
            "Fano factor of the pixels' counts": self.fano,
            "pixels above 50 events": float(self.above_50),
            "median interval of a pixel, ms": 1e3 * float(np.median(self.intervals_s))
            if self.intervals_s.size
            else np.nan,
        }


def activity(events: Events, size: tuple[int, int], seconds: float, chosen: _Bools | None = None) -> Activity:
    """Return the statistics of (n,) EVENT in `seconds`, of a sensor of `size` = (width, height).

    `chosen`, (height, width), are the pixels that count; None: all.
    """
    kept = np.ones(size[::-1], bool) if chosen is None else chosen
    events = events[kept[events["y"], events["x"]]]
    pixel = events["y"].astype(np.int64) * size[0] + events["x"]
    counts = np.bincount(pixel, minlength=kept.size)[kept.reshape(-1)]
    order = np.lexsort([events["t"], pixel])
    same = np.diff(pixel[order]) == 0
    intervals = np.diff(events["t"][order].astype(np.float64))[same] * 1e-6
    opposite = np.diff(events["on"][order].astype(np.int8))[same] != 0
    since_us = events["t"] - events["t"][0] if len(events) else events["t"]
    per_ms, per_10_ms = (_per(since_us, ms, seconds) for ms in (1, 10))
    return Activity(
        seconds, int(counts.size), len(events),
        on_share=_mean(events["on"]), silent_share=_mean(counts == 0), opposite_share=_mean(opposite),
        fano=float(counts.var() / counts.mean()) if counts.sum() else np.nan, above_50=int((counts > 50).sum()),
        counts=counts, intervals_s=intervals, opposite=opposite, per_ms=per_ms, per_10_ms=per_10_ms,
    )  # fmt: skip


def _mean(values: Mask) -> float:
    return float(values.mean()) if values.size else np.nan


def _per(since_us: npt.NDArray[np.uint64], ms: int, seconds: float) -> Int64s:
    stretches = max(1, int(seconds * 1000 / ms))
    return np.bincount(np.minimum(since_us // (1000 * ms), stretches - 1).astype(np.int64), minlength=stretches)


def still_pixels(events: Events, size: tuple[int, int], seconds: float, most_hz: float) -> _Bools:
    """Return the pixels, (height, width), whose neighbours fire at `most_hz` a pixel at most, their own rate left out.

    So a hot pixel in a still part of the scene counts as still, and a pixel under a moving edge does not.
    """
    counts = np.bincount(events["y"].astype(np.int64) * size[0] + events["x"], minlength=size[0] * size[1])
    picture = np.minimum(counts.reshape(size[::-1]).astype(np.float64), 4 * most_hz * seconds + 2)
    inside = uniform_filter(np.ones_like(picture), _NEIGHBOURHOOD, mode="constant") * _NEIGHBOURHOOD**2 - 1
    around = uniform_filter(picture, _NEIGHBOURHOOD, mode="constant") * _NEIGHBOURHOOD**2 - picture
    return np.asarray(around / inside <= most_hz * seconds + 1e-9)


def distances(recorded: Activity, simulated: Activity) -> dict[str, float]:
    """Return the distances of two streams: ratio of rates, differences of shares, Kolmogorov-Smirnov distances."""
    return {
        "rate, simulated over recorded": simulated.rate_hz / recorded.rate_hz if recorded.events else np.nan,
        "ON share, difference": simulated.on_share - recorded.on_share,
        "silent share, difference": simulated.silent_share - recorded.silent_share,
        "opposite share, difference": simulated.opposite_share - recorded.opposite_share,
        "Fano factor, ratio": simulated.fano / recorded.fano,
        "intervals of a pixel, KS": _ks(recorded.intervals_s, simulated.intervals_s),
        "counts of the pixels, KS": _ks(recorded.counts, simulated.counts),
        "events in 1 ms, KS": _ks(recorded.per_ms, simulated.per_ms),
        "events in 10 ms, KS": _ks(recorded.per_10_ms, simulated.per_10_ms),
    }


def _ks(a: npt.NDArray[np.generic], b: npt.NDArray[np.generic]) -> float:
    if not (a.size and b.size):
        return np.nan
    few = (one[:: -(-one.size // _MOST_INTERVALS)] for one in (a, b))
    return float(stats.ks_2samp(*few, method="asymp").statistic)


_LEAK_ON_SHARE, _LEAK_OPPOSITE = 0.95, 0.1
_PAIRED_S = 0.05
_MOSTLY = 2.0
_CHANCE = 0.01
_ROUNDS = 20
_SURELY_NOT_HOT = 0.998  # of the pixels
_LEAST_HOT = 3.0


def fit(recorded: Activity) -> dict[str, float | dict[str, float]]:
    """Return the fitted parameters by their keys; those of a table in a dictionary.

    Raises ValueError where the recording has no events.
    """
    if not recorded.events:
        raise ValueError("no events to fit a sensor to")
    alternating = recorded.opposite_share if recorded.intervals_s.size else 0.0
    quiet: dict[str, float] = {"rms": 0.0}
    if recorded.on_share > _LEAK_ON_SHARE and alternating < _LEAK_OPPOSITE:
        spread = _spread(recorded.counts, 0.0)
        return {
            "leak_hz": recorded.rate_hz, "leak_spread": spread, "parasitic_hz_at_reference": 0.0, "noise": quiet,
            "background": {"hz": 0.0, "hot_share": 0.0},
        }  # fmt: skip
    return {"leak_hz": 0.0, "parasitic_hz_at_reference": 0.0, "noise": quiet, "background": _background(recorded)}


def _background(recorded: Activity) -> dict[str, float]:
    hot = recorded.counts > _most(recorded)
    ordinary = recorded.counts[~hot]
    pair, pair_s = _pairs(recorded, int(ordinary.sum()), hot)
    first_on = float(np.clip((recorded.on_share * (1 + pair) - pair) / (1 - pair), 0, 1))
    hot_events = int(recorded.counts[hot].sum())
    return {
        "hz": float(ordinary.mean() / recorded.seconds),
        "spread": _spread(ordinary, pair),
        "off_share": 1 - first_on,
        "pair_share": pair,
        "pair_us": float(np.clip(pair_s * 1e6, 1, 1e7)),
        "hot_share": float(hot.mean()),
        "hot_hz": hot_events / max(int(hot.sum()), 1) / recorded.seconds,
        "hot_pair_share": _hot_pairs(recorded.opposite_share, first_on) if hot_events else 0.0,
    }


def _most(recorded: Activity) -> float:
    """Return the largest count of a pixel that is not hot."""
    counts = np.sort(recorded.counts)
    most = float(counts[int(_SURELY_NOT_HOT * (counts.size - 1))])
    for _ in range(_ROUNDS):
        ordinary = counts[counts <= most]
        # Pairs and unequal rates widen a Poisson number: a negative binomial one with the variance found.
        mean, variance = max(float(ordinary.mean()), 1e-9), float(ordinary.var())
        size = mean**2 / max(variance - mean, 1e-6 * mean)
        bound = float(stats.nbinom.isf(_CHANCE / counts.size, size, size / (size + mean)))
        if bound <= most:
            break
        most = bound
    return max(most, _LEAST_HOT)


def _pairs(recorded: Activity, events: int, hot: Mask) -> tuple[float, float]:
    """Return the share of primaries with a follower, and the mean wait for it, s, of pixels that are not hot."""
    ordinary = ~np.repeat(hot, np.maximum(recorded.counts - 1, 0))
    intervals_s, opposite = recorded.intervals_s[ordinary], recorded.opposite[ordinary]
    short = opposite & (intervals_s < _PAIRED_S)
    by_chance = events * (events / max(int((~hot).sum()), 1)) * _PAIRED_S / recorded.seconds / 2
    seconds, wait_s = (
        max(float(short.sum()) - by_chance, 0.0),
        float(intervals_s[short].mean()) if short.any() else 1e-3,
    )
    late, late_wait_s = _slow_followers(intervals_s, opposite, recorded)
    if late > _MOSTLY * seconds:
        seconds, wait_s = late, late_wait_s
    return min(seconds / max(events - seconds, 1.0), 0.95), wait_s


def _slow_followers(intervals_s: Floats, opposite: _Bools, recorded: Activity) -> tuple[float, float]:
    """Return the number of followers at any time, and their mean wait, s."""
    on = recorded.on_share
    same = on**2 + (1 - on) ** 2
    by_chance = float((~opposite).sum()) * (1 - same) / same
    found = float(opposite.sum()) - by_chance
    if found < 1 or not (~opposite).any():
        return 0.0, 1e-3
    sum_s = float(intervals_s[opposite].sum()) - by_chance * float(intervals_s[~opposite].mean())
    wait_s = _wait_s(max(sum_s / found, 1e-6), recorded.seconds)
    turns = recorded.seconds / wait_s
    return found / (1 + math.expm1(-turns) / turns), wait_s


def _wait_s(seen_s: float, seconds: float) -> float:
    """Return the mean of an exponential wait, of which `seen_s` is the mean of those that end within a recording.

    The event before lies anywhere in the recording. Waits longer than it look alike, so that it is the most.
    """

    def excess_s(wait_s: float) -> float:
        turns = seconds / wait_s
        rest = math.exp(-turns)
        weight = wait_s * seconds - wait_s**2 * (1 - rest)
        moment = seconds * wait_s**2 * (1 - rest * (1 + turns)) - wait_s**3 * (2 - rest * (turns**2 + 2 * turns + 2))
        return moment / weight - seen_s

    return float(optimize.brentq(excess_s, seen_s / 2, seconds)) if excess_s(seconds) > 0 else seconds


def _hot_pairs(opposite: float, first_on: float) -> float:
    same = first_on**2 + (1 - first_on) ** 2
    other = 1 - same
    return float(np.clip((opposite - other) / max(1 + same - other - opposite, 1e-9), 0, 1))


def _spread(counts: Int64s, pair: float) -> float:
    """Return the log-normal spread of the rates, from the variance of the counts."""
    mean = float(counts.mean())
    if mean == 0:
        return 0.0
    at_one_rate = mean * (1 + 3 * pair) / (1 + pair)
    return min(math.sqrt(math.log1p(max(float(counts.var()) - at_one_rate, 0) / mean**2)), 3.0)


def toml(figures: dict[str, float | dict[str, float]], remark: str) -> str:
    """Return the figures as tables of a rig."""
    lines = [f"# {remark}", "[camera.sensor]"]
    lines += [f"{key} = {value:.6g}" for key, value in figures.items() if not isinstance(value, dict)]
    for name, part in figures.items():
        if isinstance(part, dict):
            lines += ["", f"[camera.sensor.{name}]", *(f"{key} = {_number(value)}" for key, value in part.items())]
    return "\n".join(lines) + "\n"


def _number(value: float) -> str:
    return f"{value:.6g}"


_STEP_NS = 20_000_000
_MOST_S = 60.0


@dataclass(frozen=True)
class Compared:
    """Statistics of a recording and of simulated sensors, by their names, the recording first.

    Attributes
    ----------
    streams : statistics by name.
    fitted : parameters of `[camera.sensor]` that match the recording best; None if they were not requested.
    reading : sentences on the comparison.
    """

    streams: Mapping[str, Activity]
    fitted: dict[str, Any] | None
    reading: list[str]

    def rows(self) -> list[dict[str, object]]:
        """Return a row for each statistic and each distance."""
        figures = {name: one.figures() for name, one in self.streams.items()}
        recorded = next(iter(self.streams.values()))
        apart = {name: distances(recorded, one) for name, one in self.streams.items()}
        rows: list[dict[str, object]] = []
        for found in (figures, apart):
            for statistic in next(iter(found.values())):
                rows.append({"statistic": statistic, **{name: of[statistic] for name, of in found.items()}})
        return rows


def compare(
    path: Path,
    sensor: tuple[str, SensorParameters],
    light: float | None = None,
    still_hz: float = 0.0,
    *,
    fitted: bool = False,
) -> Compared:
    """Measure a recording, and the sensor (name and parameters) in still light for the same time.

    `light` is that on the whole simulated sensor. Without it, and where the recording has frames of the sensor's size,
    the light is the mean of these frames, the sensor's own frames run, and only pixels count that see no motion in the
    frames; else the light is 1. `still_hz` above 0: only pixels of the recording count whose neighbours fire at that
    rate at most.

    Raises
    ------
    SceneError
        The file cannot be read or holds no events.
    ValueError
        No pixel of the recording is still.
    """
    name, parameters = sensor
    events, size = read_events(path)
    size = size or (
        max(parameters.width, int(events["x"].max()) + 1),
        max(parameters.height, int(events["y"].max()) + 1),
    )
    seconds = max(float(events["t"][-1] - events["t"][0]) * 1e-6, 1e-3)
    chosen = still_pixels(events, size, seconds, still_hz) if still_hz else None
    seen = _seen(path, parameters, int(events["t"][0])) if light is None else None
    if seen is not None:
        chosen = seen.still if chosen is None else seen.still & chosen
    if chosen is not None and not chosen.any():
        raise ValueError(f"{path}: no pixel has neighbours that fire at {still_hz:g} Hz at most; allow more")
    recorded = activity(events, size, seconds, chosen)
    under = _Light(1.0 if light is None else light, seen, chosen if seen is not None else None)
    streams = {path.name: recorded, name: _simulated(parameters, under, seconds)}
    figures = fit(recorded) if fitted else None
    if figures is not None:
        streams[f"{name}, fitted"] = _simulated(_with(parameters, figures), under, seconds)
    extent = (
        f"{recorded.pixels} of {size[0] * size[1]} pixels of {path.name}, {seconds:.3g} s, {recorded.events} events"
    )
    return Compared(streams, figures, [f"{extent}; {under.beside(name, parameters)}, same time.", under.limits()])


def _seen(path: Path, p: SensorParameters, begin_us: int) -> StillLight | None:
    """Return the still light of a recording's frames; None without frames of the sensor's size."""
    frames = [frame for frame in read_frames(path) if frame.pixels.shape[:2] == (p.height, p.width)]
    return still_light(frames, begin_us)


@dataclass(frozen=True)
class _Light:
    """Light on the simulated sensor: uniform, or that of frames; and the pixels that count, None: all."""

    uniform: float
    seen: StillLight | None
    chosen: _Bools | None

    def beside(self, name: str, p: SensorParameters) -> str:
        """Return the simulated side in words."""
        if self.seen is None:
            return f"beside {p.width} x {p.height} pixels of {name} in still light {self.uniform:g}"
        return f"beside the same pixels of {name} under the mean of the recording's frames, its own frames on"

    def limits(self) -> str:
        """Return in words what the comparison leaves out."""
        if self.seen is None:
            return (
                f"No light of the recording is used: all pixels have light {self.uniform:g} and no frames are read, so "
                "noise and leak over light, kicks by frames and everything that moves cannot be compared."
            )
        return (
            f"Only pixels that see no motion in the frames count (level {REFERENCE_DN:g} of 255 is light 1); the light "
            "of the others between two frames is not known."
        )


def _with(p: SensorParameters, figures: Mapping[str, Any]) -> SensorParameters:
    parts = {
        key: dataclasses.replace(getattr(p, key), **value) if isinstance(value, dict) else value
        for key, value in figures.items()
    }
    return dataclasses.replace(p, **parts)


def _simulated(p: SensorParameters, light: _Light, seconds: float) -> Activity:
    """Return the statistics of the sensor in still light, at most `_MOST_S` of them."""
    seconds = min(seconds, _MOST_S)
    events = (
        _in_uniform_light(p, light.uniform, seconds) if light.seen is None else still_events(p, light.seen, seconds)
    )
    return activity(events, (p.width, p.height), seconds, light.chosen)


def _in_uniform_light(p: SensorParameters, light: float, seconds: float) -> Events:
    picture, sensor = np.full((p.height, p.width), light, np.float32), Sensor(p, 1)
    sensor.reset(LightFrame(0, picture))
    ends = [min(k * _STEP_NS, round(seconds * 1e9)) for k in range(1, math.ceil(seconds * 1e9 / _STEP_NS) + 1)]
    parts: list[Events] = [sensor.expose(LightFrame(end, picture)) for end in ends]
    return np.concatenate([*parts, sensor.finish()])


def write_comparison(found: Compared, name: str, out: Path) -> list[Path]:
    """Write page, tables and the fitted parameters, if any, into a folder; return the files, page first."""
    rows = found.rows()
    files = [
        write_csv(rows, out / "recording.csv"),
        write_json({"reading": found.reading, "statistics": rows, "fit": found.fitted}, out / "recording.json"),
    ]
    page = Page(f"{name} beside a recording").findings(found.reading).records(rows)
    if found.fitted is not None:
        path = out / "fit.toml"
        path.write_text(toml(found.fitted, found.reading[0]), encoding="utf-8")
        files.append(path)
    return [page.write(out / "recording.html"), *files]
