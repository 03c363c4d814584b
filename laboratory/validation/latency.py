"""Experiments with NIST's latencies: medians, spread, opposite polarity and size of the region, with pictures."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator
from functools import partial
from pathlib import Path

import numpy as np

from emulator.report.page import figure_legend, panels, pyplot, save
from emulator.sensor.presets import IMX636_W_M2, PRESETS
from laboratory.validation.findings import Datum, Findings, Kind
from laboratory.validation.nist import NIST, Row, Statistics, first_latencies, latencies, pulsed, table

_HIGHEST_USUAL = 35
_BOUND, _BOUND_BEYOND, _BOUND_LENS, _BOUND_GEN31 = 0.10, 0.25, 0.20, 0.20
_SPREAD_BOUND, _NOISE_BOUND, _FEW_BOUND = 1.25, 1.5, 1.5
_FEWEST_COUNTED, _MOST_COUNTED = 3, 100.0
_RISE_BOUND_US, _REGION_W_M2 = 5.0, 0.1658
_COUNTED_PIXELS, _MOST_EDGES = 65_536, 16  # so many that single late pixels move a mean by less than 1 us
_UNIT, _FACTORY, _POLARITIES = "imx636_nist", (0, 0), {1.0: "ON", 0.0: "OFF"}

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


def _ours(row: Row, seed: int, unit: str = _UNIT) -> Statistics:
    """Return our statistics under the condition of a row."""
    on, off = latencies(unit, row["irradiance_w_m2"], _biases(row), seed)
    return on if row["polarity"] else off


def _condition(row: Row) -> str:
    name = "factory biases" if _biases(row) == _FACTORY else "biases {:+d}, {:+d}".format(*_biases(row))
    lens = " behind a lens" if row["lens"] else ""
    return f"{_POLARITIES[row['polarity']]} at {row['irradiance_w_m2']:.3g} W/m2{lens}, {name}"


def _regions_apart(row: Row, name: str) -> float:
    """Return the largest ratio of a region's value and the middle one, `name` without its unit; NaN: not readable."""
    middle = row[f"{name}_us"]
    return max(row[f"{name}_hi"] / middle, middle / row[f"{name}_lo"])


def latency(seed: int) -> Findings:
    """Return medians of the latency at five irradiances and seven pairs of biases, both polarities, and with a lens."""
    rows = table("nist_latency")
    data = tuple(_median(row, _ours(row, seed)) for row in rows)
    remarks = (
        "diff_on and diff_off move together; other biases stay at the factory's values.",
        "Corner, poles, delays and slopes of the biases were fitted to the medians of the bare sensor.",
        "From diff_off +47 on, a part of the real latency to OFF events does not follow the light: about 30 us at +47, "
        "190 us at +95 and 1.3 ms at +142. The preset has a delay of OFF events that rises with diff_off as an "
        "exponential, as that of a comparator whose current falls.",
        "Behind a lens NIST states the same irradiance, and not the transmission of the lens. We simulate no lens; the "
        "real latencies are 8 % longer.",
        "Apart are the nine regions of the one chip: the largest ratio of a region's median and the middle one.",
        _OPEN,
    )
    return Findings(
        "latency", "Latency over light and biases", _UNIT, _PROTOCOL, (NIST,), data, remarks,
        partial(_draw, rows, data, 0.0, "median latency, us"),
    )  # fmt: skip


def _median(row: Row, ours: Statistics, usual: float = _BOUND) -> Datum:
    beyond = row["diff_on"] > _HIGHEST_USUAL
    bound = _BOUND_BEYOND if beyond else _BOUND_LENS if row["lens"] else usual
    remark = "the biases are extreme" if beyond else "a lens of unknown transmission is in front" if row["lens"] else ""
    apart = _regions_apart(row, "median") - 1
    return Datum(
        _condition(row), row["median_us"], ours.median_us, "us", "relative", bound, not row["lens"], apart, remark
    )  # fmt: skip


def gen31(seed: int) -> Findings:
    """Return medians of the latency of a Gen 3.1, and how many of its pixels have an event of the other polarity."""
    unit = "gen31_nist"
    pairs = [(row, _ours(row, seed, unit)) for row in table("nist_latency_gen31")]
    medians = (_median(row, ours, _BOUND_GEN31) for row, ours in pairs)
    others = (
        Datum(f"other polarity, {_condition(row)}", row["opposite"], ours.opposite, "of 111", "difference", 1.0, True)
        for row, ours in pairs
    )
    remarks = (
        "Thresholds, corner, delays and a bound of the noise were fitted to these rows. A step of a bias is 7 mV of "
        "its distance from diff, which at the factory's values is 138 and 132 mV.",
        "The part of the real ON latency that no light shortens rises by 1 % a mV; the preset has a constant.",
    )
    return Findings("gen31", "Gen 3.1: latency and noise", unit, _PROTOCOL, (NIST,), (*medians, *others), remarks)


def spread(seed: int) -> Findings:
    """Return the fastest and the slowest pixel of a region over the median, at the factory's biases."""
    rows = [row for row in table("nist_latency") if _biases(row) == _FACTORY]
    data = tuple(datum for row in rows for datum in _extremes(row, _ours(row, seed)))
    remarks = (
        "The fastest pixels are in part pixels whose noise came before the true event, and the slowest are in part "
        "pixels that come milliseconds late.",
        "Beyond noise, pixels differ by the position of their reference, up to one threshold of the other polarity "
        "away from the light, and by the mismatch of the thresholds, "
        f"{100 * PRESETS[_UNIT].mismatch:.1f} %.",
        "After OFF edges of the brightest light, at biases from -21 on, about 1 % of the real pixels come after some "
        "3 ms, in each cycle; this is not modelled: in other light, at other biases and after ON edges they do not.",
        "Apart are the nine regions, as for the medians.",
    )
    return Findings("spread", "Spread of latencies in a region", _UNIT, _PROTOCOL, (NIST,), data, remarks)


def _extremes(row: Row, ours: Statistics) -> Iterator[Datum]:
    for name, column, here in (("fastest", "min", ours.least_us), ("slowest", "max", ours.most_us)):
        real = row[f"{column}_us"] / row["median_us"]
        yield Datum(
            f"{_condition(row)}: {name} over median", real, here / ours.median_us, "", "factor", _SPREAD_BOUND,
            not row["lens"], _regions_apart(row, column),
        )  # fmt: skip


def opposite(seed: int) -> Findings:
    """Return how many pixels also have an event of the other polarity within the half period: noise, over light."""
    rows = table("nist_latency")
    twins = {
        (row["polarity"], row["irradiance_w_m2"], row["diff_on"], 1 - row["lens"]): row["opposite"] for row in rows
    }
    data = tuple(
        _opposite(row, twins[row["polarity"], row["irradiance_w_m2"], row["diff_on"], row["lens"]], _ours(row, seed))
        for row in rows
    )
    remarks = (
        "After an ON edge these are OFF events in the LED's light, after an OFF edge ON events in the dark. Some may "
        "be rebound after the step rather than noise.",
        "Noise and dark current of the preset were fitted to the counts of the bare sensor.",
        "100 stands for 100 or more: NIST's map ends there, and ours is cut there too. Counts near 100 and below 3 "
        "agree easily and show little.",
        "Apart is the same camera with and without its lens. NIST's two cameras agree within x 1.03 in the middle, so "
        "that a bound of x 1.50 is far wider than the difference of two cameras.",
    )
    protocol = _PROTOCOL + (
        " NIST numbers 121 pixels by x + 10 y, which gives 111 numbers; counted are "
        "those with an event of the other polarity."
    )
    return Findings(
        "opposite", "Events of the other polarity", _UNIT, protocol, (NIST,), data, remarks,
        partial(_draw, rows, data, 0.05, "pixels of 111"),
    )  # fmt: skip


def _opposite(row: Row, twin: float, ours: Statistics) -> Datum:
    real, here = row["opposite"], min(ours.opposite, _MOST_COUNTED)
    few = real < _FEWEST_COUNTED
    kind: Kind = "difference" if few else "factor"
    bound, remark = (_FEW_BOUND, f"fewer than {_FEWEST_COUNTED} pixels are real") if few else (_NOISE_BOUND, "")
    apart = abs(real - twin) if few else max(real / max(twin, 0.01), twin / real)
    return Datum(_condition(row), real, here, "of 111", kind, bound, not row["lens"], apart, remark)


def region(seed: int) -> Findings:
    """Return the rise of the mean latency with the size of the region: the time of the read-out."""
    rows = table("nist_region")
    ours = {side: _means_us(int(side), seed) for side in sorted({row["side"] for row in rows})}
    data = tuple(
        datum
        for lens in (0, 1)
        for polarity, least in ((1.0, 32.0), (0.0, 128.0))
        for datum in _rises(rows, lens, polarity, least, ours)
    )
    protocol = (
        "Squares of 32 to 420 pixels' side, of which all pixels respond; the mean latency over pixels, as rise above "
        "that of the smallest square. Factory biases; the irradiance is not stated, and here it is 0.166 W/m2."
    )
    remarks = (
        "To OFF events the rise counts from side 128: in smaller squares the real mean is that of a few pixels that "
        "come milliseconds late.",
        "Uneven light over the larger squares would add to the real rise.",
        "Time of a row and of an event were fitted to the rises of the bare sensor. Apart is the same camera with and "
        "without its lens.",
        _OPEN,
    )
    return Findings("region", "Latency over the size of the region", _UNIT, protocol, (NIST,), data, remarks)


def _means_us(side: int, seed: int) -> dict[float, float]:
    """Return the mean latency of a square of pixels to ON and to OFF events, us."""
    p = dataclasses.replace(PRESETS[_UNIT], width=side, height=side)
    counted = max(1, min(_MOST_EDGES, _COUNTED_PIXELS // side**2))
    edges = pulsed(p, _REGION_W_M2, seed, counted + 1)
    times = {True: edges.on_us[1:], False: edges.off_us}
    means = {
        on: [first_latencies(edges.after(int(t)), int(t), on).mean() for t in edges_us]
        for on, edges_us in times.items()
    }
    return {float(on): float(np.mean(values)) for on, values in means.items()}


def _rises(
    rows: tuple[Row, ...], lens: int, polarity: float, least: float, ours: dict[float, dict[float, float]]
) -> Iterator[Datum]:
    mean_us = {(row["lens"], row["side"]): row["mean_us"] for row in rows if row["polarity"] == polarity}
    for side in sorted(ours):
        if side > least:
            real, twin = (mean_us[k, side] - mean_us[k, least] for k in (lens, 1 - lens))
            here = ours[side][polarity] - ours[least][polarity]
            what = f"{_POLARITIES[polarity]}{' behind a lens' * lens}, side {side:.0f} above side {least:.0f}"
            yield Datum(what, real, here, "us", "difference", _RISE_BOUND_US, not lens, abs(real - twin))


def _draw(rows: tuple[Row, ...], data: tuple[Datum, ...], least: float, label: str, stem: Path) -> list[Path]:
    """Draw real values as marks, hollow behind a lens, and ours as lines over light, one colour a pair of biases."""
    figure, axes = panels(2, 2, 5.0, 4.2)
    pairs = sorted({_biases(row) for row in rows})
    colours = pyplot().get_cmap("viridis")(np.linspace(0, 0.9, len(pairs)))
    for (polarity, name), (one,) in zip(_POLARITIES.items(), axes, strict=True):
        one.set(title=f"{name} events (hollow: with a lens)", xlabel="irradiance, W/m2", ylabel=label)
        one.loglog()
        for biases, colour in zip(pairs, colours, strict=True):
            for lens, fill in ((0, "full"), (1, "none")):
                chosen = [k for k, row in enumerate(rows) if (row["polarity"], row["lens"]) == (polarity, lens)]
                chosen = [k for k in chosen if _biases(rows[k]) == biases]
                light = [rows[k]["irradiance_w_m2"] for k in chosen]
                one.plot(light, [max(data[k].real, least) for k in chosen], "o", color=colour, ms=4, fillstyle=fill)
            one.plot(
                light,
                [max(data[k].ours, least) for k in chosen],
                color=colour,
                label="biases {:+d}, {:+d}".format(*biases),
            )
    figure_legend(figure, ncols=4)
    return save(figure, stem)
