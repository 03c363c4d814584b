"""Experiments with NIST's latencies: medians, spread, opposite polarity and size of the region, with pictures."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from functools import cache, partial
from pathlib import Path
from typing import Any

import numpy as np

from emulator.report.page import BLUE, INK, RED, figure_legend, panels, pyplot, save
from emulator.sensor.presets import IMX636_W_M2, PRESETS
from laboratory.validation.findings import Datum, Findings
from laboratory.validation.nist import NIST, Row, Statistics, first_latencies, latencies, pulsed, table

_HIGHEST_FITTED = 35
_BOUND = 0.10
_NOISE_BOUND = 1.5
_FEWEST_COUNTED, _MOST_COUNTED = 3, 100.0
_RISE_BOUND_US = 5.0
_REGION_W_M2 = 0.1658
_COUNTED_PIXELS, _MOST_EDGES = 65_536, 16  # so many that single late pixels move a mean by less than 1 us
_FACTORY = 0, 0
_POLARITIES = {1.0: "ON", 0.0: "OFF"}
_COLOURS = {1.0: BLUE, 0.0: RED}

_PROTOCOL = (
    "A red LED switches on and off in front of the bare sensor, half a second each. The latency of a pixel is that of "
    "its first event of the edge's polarity after the edge; noise that comes before counts. Nine regions of 11 x 11 "
    "pixels, statistics over the pixels of a region for each edge, then their mean over edges. We repeat this with the "
    "preset as it stands, with noise, background and read-out, over five cycles of which the first is left out; "
    f"our edges are jumps, and the irradiance becomes light by the preset's unit, {IMX636_W_M2} W/m2."
)
_OPEN = (
    "Not stated by NIST: rise and fall time of the LED, delay of the trigger, temperature. The camera is a SilkyEvCam "
    "HD; its sensor is an IMX636 or an IMX646."
)


def _biases(row: Row) -> tuple[int, int]:
    return int(row["diff_on"]), int(row["diff_off"])


@cache
def _simulated(irradiance_w_m2: float, biases: tuple[int, int], seed: int) -> tuple[Statistics, Statistics]:
    return latencies(irradiance_w_m2, biases, seed)


def _ours(row: Row, seed: int) -> Statistics:
    """Return our statistics under the condition of a row."""
    on, off = _simulated(row["irradiance_w_m2"], _biases(row), seed)
    return on if row["polarity"] else off


def _condition(row: Row) -> str:
    name = "factory biases" if _biases(row) == _FACTORY else "biases {:+d}, {:+d}".format(*_biases(row))
    return f"{_POLARITIES[row['polarity']]} at {row['irradiance_w_m2']:.3g} W/m2, {name}"


def latency(seed: int) -> Findings:
    """Return medians of the latency at five irradiances and seven pairs of biases, both polarities."""
    rows = table("latency")
    data = tuple(_median(row, _ours(row, seed)) for row in rows)
    remarks = (
        "diff_on and diff_off move together; other biases stay at the factory's values.",
        "Unit of light, second pole, delays and exponents of the biases were fitted to these medians: "
        "agreement shows that the law of the pixel can follow them, not that it predicts them.",
        "From diff_off +47 on, a part of the real latency to OFF events does not follow the light: about 30 us at +47, "
        "190 us at +95 and 1.3 ms at +142. The preset has a delay of OFF events that rises with diff_off as an "
        "exponential, as that of a comparator whose current falls; it was fitted to these values.",
        _OPEN,
    )
    return Findings(
        "latency", "Latency over light and biases", "imx636", _PROTOCOL, (NIST,), data, remarks,
        partial(_draw_medians, rows, data),
    )  # fmt: skip


def _median(row: Row, ours: Statistics) -> Datum:
    judged = row["diff_on"] <= _HIGHEST_FITTED
    remark = "" if judged else "biases beyond those that the preset was fitted to"
    bound = _BOUND if judged else math.nan
    return Datum(_condition(row), row["median_us"], ours.median_us, "us", "relative", bound, remark)


def spread(seed: int) -> Findings:
    """Return the fastest and the slowest pixel of a region over the median, at the factory's biases."""
    rows = [row for row in table("latency") if _biases(row) == _FACTORY]
    data = tuple(datum for row in rows for datum in _extremes(row, _ours(row, seed)))
    remarks = (
        "Not judged: the fastest pixels are in part pixels whose noise came before the true event, and the slowest "
        "are in part pixels that come milliseconds late.",
        "Beyond noise, pixels differ by the position of their reference, up to one threshold of the other polarity "
        "away from the light, and by the mismatch of the thresholds.",
    )
    return Findings(
        "spread", "Spread of latencies in a region", "imx636", _PROTOCOL, (NIST,), data, remarks,
        partial(_draw_spread, rows, [_ours(row, seed) for row in rows]),
    )  # fmt: skip


def _extremes(row: Row, ours: Statistics) -> Iterator[Datum]:
    for name, real, here in (("fastest", "min_us", ours.least_us), ("slowest", "max_us", ours.most_us)):
        what = f"{_condition(row)}: {name} over median"
        remark = "noise that comes before counts" if name == "fastest" else "some pixels come milliseconds late"
        yield Datum(what, row[real] / row["median_us"], here / ours.median_us, "", "relative", math.nan, remark)


def opposite(seed: int) -> Findings:
    """Return how many pixels also have an event of the other polarity within the half period: noise, over light."""
    rows = table("latency")
    data = tuple(_opposite(row, _ours(row, seed)) for row in rows)
    remarks = (
        "After an ON edge these are OFF events in the LED's light, after an OFF edge ON events in the dark. Some may "
        "be rebound after the step rather than noise.",
        "Noise and dark current of the preset were fitted to these counts: agreement shows that the law of the noise "
        "can follow them over light, in the dark and over biases with four values, not that it predicts them.",
        "100 stands for 100 or more: NIST's map ends there.",
    )
    protocol = _PROTOCOL + " Counted are the pixel keys, of 111, with an event of the other polarity."
    return Findings(
        "opposite", "Events of the other polarity", "imx636", protocol, (NIST,), data, remarks,
        partial(_draw_opposite, rows, [_ours(row, seed) for row in rows]),
    )  # fmt: skip


def _opposite(row: Row, ours: Statistics) -> Datum:
    real, here = row["opposite"], min(ours.opposite, _MOST_COUNTED)
    remark = "NIST's map ends at 100" if real >= _MOST_COUNTED else ""
    remark = f"fewer than {_FEWEST_COUNTED} pixels: chance" if real < _FEWEST_COUNTED else remark
    bound = math.nan if remark else _NOISE_BOUND
    return Datum(_condition(row), real, here, "of 111", "factor", bound, remark)


def region(seed: int) -> Findings:
    """Return the rise of the mean latency with the size of the region: the time of the read-out."""
    rows = table("region")
    ours = {side: _means_us(int(side), seed) for side in sorted({row["side"] for row in rows})}
    data = tuple(
        datum
        for polarity, least in ((1.0, 32.0), (0.0, 128.0))
        for datum in _rises([row for row in rows if row["polarity"] == polarity], ours, least)
    )
    protocol = (
        "Squares of 32 to 420 pixels' side, of which all pixels respond; the mean latency over pixels, as rise above "
        "that of the smallest square. Factory biases; the irradiance is not stated, and here it is 0.166 W/m2."
    )
    remarks = (
        "To OFF events the rise counts from side 128: in smaller squares the real mean is that of a few pixels that "
        "come milliseconds late.",
        "Uneven light over the larger squares would add to the real rise.",
        _OPEN,
    )
    return Findings(
        "region", "Latency over the size of the region", "imx636", protocol, (NIST,), data, remarks,
        partial(_draw_region, rows, ours),
    )  # fmt: skip


def _means_us(side: int, seed: int) -> dict[float, float]:
    """Return the mean latency of a square of pixels to ON and to OFF events, us."""
    p = dataclasses.replace(PRESETS["imx636"], width=side, height=side)
    counted = max(1, min(_MOST_EDGES, _COUNTED_PIXELS // side**2))
    edges = pulsed(p, _REGION_W_M2, seed, counted + 1)
    times = {True: edges.on_us[1:], False: edges.off_us}
    means = {
        on: [first_latencies(edges.after(int(t)), int(t), on).mean() for t in edges_us]
        for on, edges_us in times.items()
    }
    return {float(on): float(np.mean(values)) for on, values in means.items()}


def _rises(rows: list[Row], ours: dict[float, dict[float, float]], least: float) -> Iterator[Datum]:
    polarity = rows[0]["polarity"]
    start = next(row for row in rows if row["side"] == least)
    for row in rows:
        if row["side"] > least:
            what = f"{_POLARITIES[polarity]}, side {row['side']:.0f} above side {least:.0f}"
            here = ours[row["side"]][polarity] - ours[least][polarity]
            yield Datum(what, row["mean_us"] - start["mean_us"], here, "us", "difference", _RISE_BOUND_US)


def _both(width_in: float, height_in: float) -> tuple[Any, dict[float, Any]]:
    """Return a figure and its two panels, by polarity."""
    figure, axes = panels(2, 2, width_in, height_in)
    for name, (one,) in zip(_POLARITIES.values(), axes, strict=True):
        one.set_title(f"{name} events")
        one.set_xlabel("irradiance, W/m2")
        one.set_xscale("log")
    return figure, {polarity: one for polarity, (one,) in zip(_POLARITIES, axes, strict=True)}


def _over_light(rows: list[Row] | tuple[Row, ...], values: list[float], polarity: float) -> Any:
    """Return irradiances and values of the rows of a polarity, (2, n), in ascending order of irradiance."""
    pairs = zip(rows, values, strict=True)
    return np.array(sorted((row["irradiance_w_m2"], value) for row, value in pairs if row["polarity"] == polarity)).T


def _draw_lines(axes: dict[float, Any], rows: tuple[Row, ...], real: list[float], ours: list[float]) -> None:
    """Draw real values as marks and ours as lines over light, one colour a pair of biases."""
    pairs = sorted({_biases(row) for row in rows})
    colours = pyplot().get_cmap("viridis")(np.linspace(0, 0.9, len(pairs)))
    for biases, colour in zip(pairs, colours, strict=True):
        some = [k for k, row in enumerate(rows) if _biases(row) == biases]
        chosen, marks, line = [rows[k] for k in some], [real[k] for k in some], [ours[k] for k in some]
        for polarity, one in axes.items():
            one.plot(*_over_light(chosen, marks, polarity), "o", color=colour, ms=4)
            label = "biases {:+d}, {:+d}".format(*biases)
            one.plot(*_over_light(chosen, line, polarity), "-", color=colour, label=label)


def _draw_medians(rows: tuple[Row, ...], data: tuple[Datum, ...], stem: Path) -> list[Path]:
    figure, axes = _both(5.0, 4.2)
    _draw_lines(axes, rows, [one.real for one in data], [one.ours for one in data])
    for one in axes.values():
        one.set_yscale("log")
        one.set_ylabel("median latency, us (marks: real; lines: ours)")
    figure_legend(figure, ncols=4)
    return save(figure, stem)


def _draw_opposite(rows: tuple[Row, ...], ours: list[Statistics], stem: Path) -> list[Path]:
    figure, axes = _both(5.0, 4.2)
    real = [max(row["opposite"], 0.05) for row in rows]
    _draw_lines(axes, rows, real, [min(max(one.opposite, 0.05), 100) for one in ours])
    for one in axes.values():
        one.set_yscale("log")
        one.set_ylabel("pixels of 111 with the other polarity (marks: real)")
    figure_legend(figure, ncols=4)
    return save(figure, stem)


def _draw_spread(rows: list[Row], ours: list[Statistics], stem: Path) -> list[Path]:
    figure, axes = _both(5.0, 4.2)
    values = {
        "slowest pixel": ("max_us", [one.most_us for one in ours]),
        "median": ("median_us", [one.median_us for one in ours]),
        "fastest pixel": ("min_us", [one.least_us for one in ours]),
    }
    for (name, (column, here)), colour in zip(values.items(), (RED, INK, BLUE), strict=True):
        for polarity, one in axes.items():
            one.plot(*_over_light(rows, [row[column] for row in rows], polarity), "o", color=colour, ms=4)
            one.plot(*_over_light(rows, here, polarity), "-", color=colour, label=name)
    for one in axes.values():
        one.set_yscale("log")
        one.set_ylabel("latency, us (marks: real; lines: ours)")
    figure_legend(figure)
    return save(figure, stem)


def _draw_region(rows: tuple[Row, ...], ours: dict[float, dict[float, float]], stem: Path) -> list[Path]:
    figure, [[one]] = panels(1, 1, 6.0, 4.2)
    sides = sorted(ours)
    for polarity, name in _POLARITIES.items():
        real = {row["side"]: row["mean_us"] for row in rows if row["polarity"] == polarity}
        colour = _COLOURS[polarity]
        one.plot(sides, [real[side] for side in sides], "o", color=colour, label=f"{name}, real")
        one.plot(sides, [ours[side][polarity] for side in sides], "-", color=colour, label=f"{name}, ours")
    one.set_xscale("log")
    one.set_xlabel("side of the square, pixels")
    one.set_ylabel("mean latency, us")
    figure_legend(figure)
    return save(figure, stem)
