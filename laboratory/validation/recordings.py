"""Two recordings of real cameras beside the simulated sensors, by two-sample tests under the recordings' own light.

A distance is Kolmogorov and Smirnov's, of at most 10^4 values of each side; as the real value stands the distance of
two halves of the recording. All quantities together are judged by a classifier. `data/SOURCES.md` names the recordings.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from scipy import stats
from scipy.spatial import cKDTree

from emulator.light import LightFrame
from emulator.report.page import BLUE, INK, figure_legend, panels, save
from emulator.sensor.parameters import KickParameters
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from firmware_protocol.events import EVENT, Events
from laboratory.characterise.recordings import still_pixels
from laboratory.characterise.still_light import StillLight, still_events
from laboratory.validation.classifier import ORDER, QUANTITIES, Samples, area, tiles
from laboratory.validation.findings import Datum, Findings, Kind, Source

DATA = Path(__file__).with_name("data")
"""Tables of the real recordings."""

QUIET_HZ = 0.02
"""Quiet pixels of the EVK4's recording: those whose neighbours fire at this rate at most."""

_MOST = 10_000
_LEVELS = (0, 10, 20, 40, 80, 120, 170, 256)
_LINE_US = 35.25
_LINES_US = 260 * _LINE_US
_KICK_US = 40
_FANO = 1.8  # of the street's events in a frame
_STREET_TILE = 16
_STREET_TILE_SHARE = 0.25
_CLUSTER_PX, _CLUSTER_US = 20.0, 20_000.0
ALIKE_TILES, ALIKE_EVENTS = 0.544, 0.572
"""Areas of a classifier between two simulated sensors in the street's light: 95 % of 36 pairs lie below."""

_Array = npt.NDArray[np.generic]


def davis346_street(seed: int) -> Findings:
    """Return the still half of the recording of a street beside the preset davis346 under the mean of its frames."""
    with np.load(DATA / "davis346_street.npz") as table:
        seen, real = _street(dict(table))
        seconds = float(table["seconds"])
    ours = still_events(PRESETS["davis346"], seen, seconds, seed)
    ours = ours[seen.still[ours["y"], ours["x"]]]
    lags = [(kick_lags(events, seen), max(len(events), 1)) for events in (real, ours)]
    kicked, emulated = (float(((us >= -1) & (us < _KICK_US)).sum()) / n for us, n in lags)
    what = f"still events within {_KICK_US} us of a kick, share"
    data = [
        *_rates(real, ours, seen, seconds),
        *_still_distances(real, ours, seen),
        *_street_areas(real, ours, seen, seconds),
        Datum(what, kicked, emulated, "", "difference", 0.05, True),
    ]
    return Findings(
        "davis346_street",
        "DAVIS346, still half of a street",
        "davis346",
        "A DAVIS346 looks at a street for 2.36 s. The half of its pixels that see no motion, chosen by its frames"
        " alone, is compared with the simulated sensor under the mean of the frames (level 80 of 255 is light 1), noise"
        " and frames on. A distance is alike where Kolmogorov and Smirnov's test does not separate the two (p > 0.05).",
        (
            Source(
                "aedat 2.3.0, tests/data/test_data.aedat4",
                "https://github.com/neuromorphicsystems/aedat",
                "MIT, Copyright (c) 2020 International Centre for Neuromorphic Systems",
                "recording shipped with the package; mean frame and still events are stored here",
            ),
        ),
        tuple(data),
        (
            "Leak, kicks and noise of the preset were fitted to this recording. Apart are two halves of its pixels.",
            "A distance that no test separates at p = 0.05 lies beyond its bound with one seed in twenty.",
            "Where pixels of level 0 to 10 are still, they fire no more than brighter ones; the higher rate that was"
            " reported for such pixels, with a third of OFF events, is that of motion near them.",
            "The light of moving pixels between two frames is not known, so they are not compared.",
            _CLASSIFIER,
            "The bound of an area is here that which two simulated sensors exceed once in twenty times. A tile has one"
            " event in the mean, too few for most of its quantities.",
        ),
        partial(_draw_street, real, ours, seen),
    )


def _street(table: dict[str, npt.NDArray[np.generic]]) -> tuple[StillLight, Events]:
    level = (table["level"].astype(np.float32) / 16).astype(np.float32)
    still = np.unpackbits(table["still"].astype(np.uint8), count=level.size).astype(np.bool_).reshape(level.shape)
    events = np.zeros(len(table["t"]), EVENT)
    for name in ("t", "x", "y", "on"):
        events[name] = table[name]
    first, interval, exposure = (int(value) for value in table["frames"].astype(np.int64))
    return StillLight(level, still, first, interval, exposure), events


def _rates(real: Events, ours: Events, seen: StillLight, seconds: float) -> list[Datum]:
    """Return events in all, ON share, and rates by level, each with the bound of Poisson numbers (2.6 deviations)."""
    data = [
        Datum("events", len(real), len(ours), "", "difference", _chance(len(real)), True),
        Datum("ON share", float(real["on"].mean()), float(ours["on"].mean()), "", "difference", 0.02, True),
    ]
    levels = seen.level[seen.still], _levels(real, seen), _levels(ours, seen)
    for low, high in pairwise(_LEVELS):
        pixels, recorded, emulated = (int(((level >= low) & (level < high)).sum()) for level in levels)
        unit = 1000 / (pixels * seconds)
        bound = unit * _chance(recorded)
        what = f"rate at level {low} to {high} ({pixels} pixels)"
        data.append(Datum(what, unit * recorded, unit * emulated, "mHz", "difference", bound, True))
    return data


def _chance(real: int) -> float:
    """Return 2.6 deviations of the difference of two numbers of events like this one."""
    return 2.6 * math.sqrt(_FANO * max(2 * real, 3))


def _levels(events: Events, seen: StillLight) -> npt.NDArray[np.float32]:
    return np.asarray(seen.level[events["y"], events["x"]])


def _still_distances(real: Events, ours: Events, seen: StillLight) -> list[Datum]:
    halves = [real[(real["x"] + real["y"]) % 2 == k] for k in (0, 1)]
    return [
        _separable(name, *(of(events, seen) for events in (real, ours, *halves)))
        for name, of in {"counts of the pixels": _counts, **_SAMPLES}.items()
    ]


def _counts(events: Events, seen: StillLight) -> _Array:
    width = seen.level.shape[1]
    counts = np.bincount(events["y"].astype(np.int64) * width + events["x"], minlength=seen.level.size)
    return counts[seen.still.reshape(-1)]


def _phase_us(events: Events, seen: StillLight) -> _Array:
    since = events["t"].astype(np.float64) - seen.first_us - _LINE_US * events["y"] + _LINE_US
    return since % seen.interval_us


def _leaps(events: Events, _: StillLight) -> _Array:
    ordered = events[np.argsort(events["t"], kind="stable")]
    return np.hypot(*(np.diff(ordered[name].astype(np.float64)) for name in ("x", "y")))


_SAMPLES: dict[str, Callable[[Events, StillLight], _Array]] = {
    "gaps between successive events": lambda events, _: np.diff(np.sort(events["t"].astype(np.int64))),
    "events in 10 ms": lambda events, _: np.bincount((events["t"] // 10_000).astype(int), minlength=236),
    "time in the frame, of the own row": _phase_us,
    "level of the pixels that fire": _levels,
    "neighbours: distance to the last event, pixels": _leaps,
}


def _street_areas(real: Events, ours: Events, seen: StillLight, seconds: float) -> list[Datum]:
    """Return the areas of a classifier of the tiles and of one of the single events."""
    of_tiles = partial(tiles, chosen=seen.still, side=_STREET_TILE, seconds=seconds, least_share=_STREET_TILE_SHARE)
    width = seen.level.shape[1]
    return [
        _areas(f"tiles of {_STREET_TILE} x {_STREET_TILE} pixels", of_tiles(real), of_tiles(ours),
               width / _STREET_TILE, ALIKE_TILES),
        _areas("single events", single_events(real, seen), single_events(ours, seen), width, ALIKE_EVENTS),
    ]  # fmt: skip


def single_events(events: Events, seen: StillLight) -> Samples:
    """Return the place of each event among frames, levels, and other events; the samples of `classifier`."""
    events = events[np.argsort(events["t"], kind="stable")]
    places, t_us = np.column_stack([events["x"], events["y"]]).astype(np.float64), events["t"].astype(np.float64)
    gaps, leaps = np.diff(t_us), _leaps(events, seen)
    cluster = cKDTree(np.column_stack([places / _CLUSTER_PX, t_us / _CLUSTER_US]))
    _, pixel, counts = np.unique(places, axis=0, return_inverse=True, return_counts=True)
    columns = [
        _phase_us(events, seen),
        (t_us - seen.first_us) % seen.interval_us,
        _levels(events, seen),
        np.append(np.nan, gaps),
        np.append(gaps, np.nan),
        np.append(np.nan, leaps),
        cKDTree(places).query(places, k=2)[0][:, 1],
        cluster.query_ball_point(cluster.data, 1.0, p=np.inf, return_length=True),
        counts[pixel.reshape(-1)],
        events["on"],
    ]
    values = np.column_stack(columns).astype(np.float32)
    return Samples(values, events["y"].astype(np.int64), events["x"].astype(np.int64))


def _areas(what: str, real: Samples, ours: Samples, width: float, bound: float) -> Datum:
    """Return the area between recording and ours beside those of two halves of the recording.

    `width` is that of the chip in the unit of the samples' places. As the real value stands the area of tiles that
    alternate, and apart are the left and the right half of the chip.
    """
    return Datum(
        f"classifier of {what}: area under the curve", area(*real.alternating()), area(real, ours), "", "statistic",
        bound, True, area(*real.sides(width)), f"n = {len(real.rows)}",
    )  # fmt: skip


_CLASSIFIER = (
    "The classifier is gradient boosting, judged in a fifth of the rows of the chip after learning from the others: an"
    " area of 0.5 is that of chance. As the real value stands the area between two halves of the recording that"
    " alternate like the fields of a chessboard; apart are the left and the right half."
)


def _separable(what: str, real: _Array, ours: _Array, first: _Array, second: _Array) -> Datum:
    """Return a distance whose bound is that of p = 0.05 for two samples as large as the real one."""
    few = [_few(one) for one in (real, ours, first, second)]
    n, halves = len(few[0]), _ks(*few[2:])
    bound = float(stats.kstwobign.isf(0.05)) * math.sqrt(2 / n)
    return Datum(what, halves, _ks(*few[:2]), "", "statistic", bound, True, halves, f"n = {n}")


def _few(values: _Array) -> _Array:
    """Return at most 10^4 of the values, spread evenly over their order."""
    return values[:: -(-values.size // _MOST)]


def _ks(a: _Array, b: _Array) -> float:
    return float(stats.ks_2samp(a, b, method="asymp").statistic) if a.size and b.size else math.nan


def kick_lags(events: Events, seen: StillLight) -> npt.NDArray[np.float64]:
    """Return the times of ON events from the kicks of their rows on, us, those of reset and of signal reads together.

    A kick begins before its read, see `KickParameters`; times from -2 to 4 ms are of use.
    """
    kicks, on = KickParameters(), events[events["on"]]
    since = on["t"].astype(np.float64) - seen.first_us - _LINE_US * on["y"]
    starts = -kicks.reset_lead_us, _LINES_US + seen.exposure_us - kicks.signal_lead_us
    half_us = seen.interval_us / 2
    return np.concatenate([(since - start + half_us) % seen.interval_us - half_us for start in starts])


_LIKE = 0.1
_QUIET_LIGHT, _QUIET_STEP_NS = 10.0, 100_000_000
_TAIL = 8
_KINDS = {"off_on": (False, True), "on_off": (True, False), "off_off": (False, False), "on_on": (True, True)}
_SEQUENCES = {
    "intervals of a pixel": tuple(_KINDS),
    "lengths of runs of one polarity": ("runs",),
    "counts of the pixels": ("counts",),
    "intervals from OFF to ON": ("off_on",),
    "intervals from ON to OFF": ("on_off",),
    "intervals from OFF to OFF": ("off_off",),
    "intervals from ON to ON": ("on_on",),
}
_HALVES = "left", "right"
QUIET_TILES = 16, 32
"""Sides of the tiles of the EVK4's recording that the classifier compares, pixels."""

_SEPARATED = 0.75


def sequences(events: Events, width: int, pixels: int) -> dict[str, _Array]:
    """Return statistics of the sequences of events in each of `pixels` pixels; those above 8 events only in counts.

    Returns
    -------
    Intervals between successive events, us, by their polarities ("off_on", ...); lengths of runs of one polarity;
    numbers of pixels with 0, 1, 2, ... events; ON and all events.
    """
    pixel = events["y"].astype(np.int64) * width + events["x"]
    order = np.lexsort([events["t"], pixel])
    pixel, on, t_us = pixel[order], events["on"][order], events["t"][order].astype(np.int64)
    _, place, counts = np.unique(pixel, return_inverse=True, return_counts=True)
    ordinary = counts[place] <= _TAIL
    same = (np.diff(pixel) == 0) & ordinary[1:]
    waits = np.diff(t_us)
    found: dict[str, _Array] = {
        name: np.sort(waits[same & (on[:-1] == a) & (on[1:] == b)]).astype(np.uint32) for name, (a, b) in _KINDS.items()
    }
    begins = np.flatnonzero(np.append(True, ~same | (on[1:] != on[:-1])))
    found["runs"] = np.bincount(np.diff(np.append(begins, len(pixel)))[ordinary[begins]])
    found["counts"] = np.append(pixels - len(counts), np.bincount(counts)[1:])
    found["events"] = np.array([np.count_nonzero(on[ordinary]), np.count_nonzero(ordinary)])
    return found


def evk4_quiet(seed: int) -> Findings:
    """Return the quiet pixels of the recording of an EVK4 beside those of the preset imx636_quiet in still light."""
    with np.load(DATA / "evk4_quiet.npz") as table:
        halves = [{name: table[f"{name}_{half}"] for name in (*_KINDS, "runs", "counts", "events")} for half in _HALVES]
        seconds = float(table["seconds"])
        stored = {side: table[f"tiles_{side}"] for side in QUIET_TILES}  # columns: row, column, quantities
    real = {side: Samples(one[:, 2:], *one[:, :2].T.astype(np.int64)) for side, one in stored.items()}
    p = PRESETS["imx636_quiet"]
    events, quiet = _quiet(p, seconds, seed)
    ours = sequences(events, p.width, int(quiet.sum()))
    emulated = {side: quiet_tiles(events, quiet, side, seconds) for side in QUIET_TILES}
    return Findings(
        "evk4_quiet",
        "EVK4, quiet pixels",
        "imx636_quiet",
        "An EVK4 (IMX636) records for 10.8 s. The pixels whose neighbours fire at 0.02 Hz at most are compared, by the"
        " sequences of events in a pixel, with those of the simulated sensor, chosen in the same way: the whole preset"
        f" in still, even light of {_QUIET_LIGHT:g}, noise, background and read-out on, for the same time. Pixels with"
        " more than 8 events count in the tail alone. A distance is alike up to 0.1.",
        (
            Source(
                "faery 0.7.1, tests/data/evt3.raw",
                "https://github.com/aestream/faery",
                "LGPL-3.0 (the package); only statistics are used",
                "recording shipped with the package's sources; intervals, runs and counts are stored here",
            ),
        ),
        (
            *_shares(halves, ours, real[32], emulated[32], p.width / 32),
            *_sequence_distances(halves, ours),
            *_quiet_areas(real, emulated, p.width),
        ),
        (
            "The background of the preset was fitted to this recording. Its light and its biases are not known: ours is"
            " bright, where noise adds little to the background.",
            "Apart are the left and the right half of the chip.",
            _CLASSIFIER,
            "The tiles consist of quiet pixels alone. In the recording their rate is a third lower than that of all"
            " quiet pixels, some of which lie near motion: rate and ON share are compared by medians over the tiles of"
            " 32 x 32 pixels. Both differ over the chip; the preset has one of each.",
        ),
        partial(_draw_quiet, halves, ours),
    )


def _quiet(p: SensorParameters, seconds: float, seed: int) -> tuple[Events, npt.NDArray[np.bool_]]:
    """Return the events of the quiet pixels of a sensor in still light, and these pixels, (height, width)."""
    sensor, light = Sensor(p, seed), np.full((p.height, p.width), _QUIET_LIGHT, np.float32)
    sensor.reset(LightFrame(0, light))
    ends_ns = [
        min(round(seconds * 1e9), (k + 1) * _QUIET_STEP_NS) for k in range(round(seconds * 1e9 / _QUIET_STEP_NS))
    ]
    events = np.concatenate([*(sensor.expose(LightFrame(t_ns, light)).copy() for t_ns in ends_ns), sensor.finish()])
    quiet = still_pixels(events, (p.width, p.height), seconds, QUIET_HZ)
    return events[quiet[events["y"], events["x"]]], quiet


def quiet_tiles(events: Events, quiet: npt.NDArray[np.bool_], side: int, seconds: float) -> Samples:
    """Return the tiles of quiet pixels alone, with `classifier.QUANTITIES`; times count from the recording's start."""
    return tiles(events, quiet, side, seconds, 1.0)


def _quiet_areas(real: dict[int, Samples], ours: dict[int, Samples], width: int) -> Iterator[Datum]:
    """Yield the areas of classifiers of tiles by all quantities, and by all but rate and ON share."""
    for side in QUIET_TILES:
        for words, quantities in (("", tuple(range(len(QUANTITIES)))), (", intervals and neighbours alone", ORDER)):
            what = f"tiles of {side} x {side} pixels{words}"
            yield _areas(what, real[side].of(quantities), ours[side].of(quantities), width / side, _SEPARATED)


def _sum(halves: list[dict[str, _Array]], name: str) -> npt.NDArray[np.int64]:
    """Return the histograms of both halves, added."""
    longest = max(len(half[name]) for half in halves)
    padded = [np.pad(half[name].astype(np.int64), (0, longest - len(half[name]))) for half in halves]
    return np.asarray(np.sum(padded, axis=0))


def _shares(
    halves: list[dict[str, _Array]], ours: dict[str, _Array], real_tiles: Samples, our_tiles: Samples, width: float
) -> Iterator[Datum]:
    real = {"off_on": np.concatenate([half["off_on"] for half in halves]), "counts": _sum(halves, "counts")}
    sides = zip((real, *halves, ours), (real_tiles, *real_tiles.sides(width), our_tiles), strict=True)
    values = zip(*(_share_values(of, one) for of, one in sides), strict=True)
    for (what, unit, kind, bound), (value, left, right, here) in zip(_SHARES, values, strict=True):
        apart = abs(left - right) if kind == "difference" else max(left / right, right / left) - (kind == "relative")
        yield Datum(what, value, here, unit, kind, bound, True, apart)


_SHARES: tuple[tuple[str, str, Kind, float], ...] = (
    ("events a pixel in the middle tile", "", "relative", 0.1),
    ("ON share in the middle tile", "", "difference", 0.02),
    ("pixels with an event in the middle tile, share", "", "difference", 0.005),
    ("median from OFF to ON", "s", "relative", 0.2),
    ("pixels above 8 events, of a million", "", "factor", 1.5),
    ("pixels above 50 events, of a million", "", "factor", 2.0),
)


def _share_values(of: dict[str, _Array], tiles_of: Samples) -> tuple[float, ...]:
    """Return the values of `_SHARES`."""
    counts = of["counts"].astype(np.int64)
    return (
        *(float(np.nanmedian(tiles_of.values[:, k])) for k in range(3)),
        float(np.median(of["off_on"].astype(np.float64))) * 1e-6,
        1e6 * float(counts[_TAIL + 1 :].sum() / counts.sum()),
        1e6 * float(counts[51:].sum() / counts.sum()),
    )


def _sequence_distances(halves: list[dict[str, _Array]], ours: dict[str, _Array]) -> list[Datum]:
    data = []
    for what, names in _SEQUENCES.items():
        parts = [_samples(half, names) for half in halves]
        real, emulated = np.concatenate(parts), _samples(ours, names)
        distance, remark = _ks(*parts), f"n = {real.size}"
        data.append(Datum(what, distance, _ks(real, emulated), "", "statistic", _LIKE, True, distance, remark))
    return data


def _samples(of: dict[str, _Array], names: tuple[str, ...]) -> _Array:
    """Return the samples of intervals, joined, or those of a histogram."""
    if names[0] in _KINDS:
        return np.concatenate([of[name] for name in names])
    return np.repeat(np.arange(len(of[names[0]])), of[names[0]].astype(np.int64))


def _cumulative(axes: Any, values: _Array, **style: Any) -> None:
    """Draw the share of the values up to each of them; at most 10^4 of them."""
    ordered = np.sort(_few(values))
    axes.step(ordered, np.arange(1, ordered.size + 1) / max(ordered.size, 1), where="post", **style)


def _draw_street(real: Events, ours: Events, seen: StillLight, stem: Path) -> list[Path]:
    """Draw the distributions that are compared, but for the counts: nearly all pixels have none."""
    titles = [f"{name}{', us' if of is _phase_us or 'gaps' in name else ''}" for name, of in _SAMPLES.items()]
    figure, every = panels(len(_SAMPLES), 3, 3.8, 3.0)
    for (axes,), of, title in zip(every, _SAMPLES.values(), titles, strict=True):
        _cumulative(axes, of(real, seen), color=INK, label="recording")
        _cumulative(axes, of(ours, seen), color=BLUE, label="ours")
        axes.set(xlabel=title, ylabel="share of values up to x", ylim=(0, 1.02))
    figure_legend(figure)
    return save(figure, stem)


def _draw_quiet(halves: list[dict[str, _Array]], ours: dict[str, _Array], stem: Path) -> list[Path]:
    """Draw the distributions of the intervals by polarities, and the number of pixels over their events."""
    figure, every = panels(len(_KINDS) + 1, 3, 3.8, 3.0)
    for (axes,), kind in zip(every, _KINDS, strict=False):
        real = np.concatenate([half[kind] for half in halves])
        _cumulative(axes, real.astype(np.float64) * 1e-6, color=INK, label="recording")
        _cumulative(axes, ours[kind].astype(np.float64) * 1e-6, color=BLUE, label="ours")
        first, second = kind.upper().split("_")
        axes.set(xlabel=f"interval from {first} to {second}, s", ylabel="share of values up to x", ylim=(0, 1.02))
    (axes,) = every[-1]
    for counts, colour in ((_sum(halves, "counts"), INK), (ours["counts"], BLUE)):
        above = np.cumsum(counts[::-1].astype(np.int64))[::-1]
        axes.loglog(np.arange(1, len(above)), above[1:], color=colour)
    axes.set(xlabel="events of a pixel, at least", ylabel="pixels")
    figure_legend(figure)
    return save(figure, stem)
