"""Background events over light: rates of presets in still, even light, ON and OFF apart, beside published figures."""

from __future__ import annotations

import dataclasses
from functools import partial
from pathlib import Path

import numpy as np
import numpy.typing as npt

from emulator.light import LightFrame
from emulator.report.page import BLUE, RED, panels, save
from emulator.scene.stars.skies import sunlight_lux
from emulator.sensor.presets import IMX636_W_M2, PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.validation.findings import Datum, Findings, Source
from laboratory.validation.nist import Row, table

_IEBCS = Source(
    "Joubert et al., Event camera simulator improvements via characterized parameters (IEBCS), noise at 161 lux",
    "doi 10.3389/fnins.2021.702765, github.com/neuromorphicsystems/IEBCS",
    "GPL-3.0; statistics only",
    "intervals of 2500 pixels in the repository's histograms; a duration of 20.8 s was inferred, so rates are +-20 %",
)
_DND21 = Source(
    "Guo and Delbruck, Low cost and latency event camera background activity denoising, DND21",
    "sites.google.com/view/dnd21",
    "figures cited",
    "two rates stated for a DAVIS346: leak about 0.2 Hz, shot noise in dim light about 10 Hz; light not stated",
)
_STREET = Source(
    "DAVIS346 recording of a street, 2.36 s, shipped with the Python package aedat",
    "github.com/neuromorphicsystems/aedat",
    "figures measured on the recording",
    "rates of still pixels by the level of the camera's frames",
)
_NOISE2PARAMS = Source(
    "Root, Mujo and Xu, Noise2Params: unification and parameter determination from noise via a probabilistic event "
    "camera model",
    "arXiv 2605.16317, github.com/yagoiroot/Noise2Params",
    "MIT (the repository); figures only",
    "rates computed from the published parameters of their model (configs/params_published.yaml)",
)

_LUX_AT_REFERENCE = 1000.0  # the DVS's corner of 3 kHz at light 1 is that at 1 klux of scene light
_LUX = 0.1, 1.0, 10.0, 50.0, 1000.0
_WIDTH, _HEIGHT, _SECONDS = 120, 80, 20
_FACTOR, _HZ = 2.0, "Hz a pixel"
_SUN_LUX = 1.4  # of sunlight that a lux of Noise2Params is worth
_Counts = npt.NDArray[np.int64]
_PROTOCOL = (
    "Still, even light for 20 s, 9600 pixels; ON and OFF events of all kinds, hot pixels included. Scene light of 1000 "
    "lux is taken as light 1."
)


def counts(p: SensorParameters, light: float, seed: int) -> _Counts:
    """Return OFF and ON events of each of 9600 pixels, (2, n), in 20 s of still, even light."""
    p = dataclasses.replace(p, width=_WIDTH, height=_HEIGHT)
    sensor, still = Sensor(p, seed), np.full((_HEIGHT, _WIDTH), light, np.float32)
    sensor.reset(LightFrame(0, still))
    steps = [sensor.expose(LightFrame(round(k * 0.1e9), still)) for k in range(1, _SECONDS * 10 + 1)]
    events = np.concatenate([*steps, sensor.finish()])
    pixel = events["y"].astype(np.int64) * _WIDTH + events["x"]
    return np.array([np.bincount(pixel[events["on"] == on], minlength=_WIDTH * _HEIGHT) for on in (False, True)])


def _rate_hz(events: _Counts) -> float:
    """Return the mean rate of a pixel, Hz."""
    return float(events.sum()) / (_WIDTH * _HEIGHT * _SECONDS)


def _over_light(p: SensorParameters, seed: int) -> list[float]:
    """Return the mean rate of a pixel in light of 0.1 to 1000 lux, Hz."""
    return [_rate_hz(counts(p, lux / _LUX_AT_REFERENCE, seed)) for lux in _LUX]


def background(seed: int) -> Findings:
    """Return the background of the preset davis346 beside published rates."""
    p = PRESETS["davis346"]
    off, on = counts(p, 161 / _LUX_AT_REFERENCE, seed)
    rates_hz = _over_light(p, seed)
    unnamed, dim = "the sensor's type and biases are not stated", "its light and biases are not stated"
    level = "light in units of the frame's level 80"
    data = (
        Datum("ON at 161 lux", 0.08, _rate_hz(on), _HZ, "factor", _FACTOR, False, remark=unnamed),
        Datum("OFF at 161 lux", 0.0003, _rate_hz(off), _HZ, "difference", 0.001, False, remark=unnamed),
        Datum("pixels of at most one ON event at 161 lux", 0.66, float((on < 2).mean()), "", "difference", 0.1, False,
              remark=unnamed),
        Datum("dim light, beside our largest rate", 10.0, max(rates_hz), _HZ, "factor", _FACTOR, False, remark=dim),
        Datum("still pixels of the street, mid level", 0.0029, rates_hz[-1], _HZ, "factor", 1.5, True, remark=level),
    )  # fmt: skip
    remarks = (
        "IEBCS's pixels are leak-like, nearly all ON, and 35 % of their events come from five of 2500 pixels.",
        "The still pixels of the street have 0.0004 Hz in the dark, one DAVIS346 of DND21 has 10 Hz in dim light, "
        "and 0.2 Hz of leak in bright light: two cameras of one type differ by more than any bound here.",
    )
    sources = _IEBCS, _DND21, _STREET
    return Findings("background", "Background events over light", "davis346", _PROTOCOL, sources, data, remarks)


def dnd21(seed: int) -> Findings:
    """Return the background of the preset davis346_noisy beside the rates that are stated for a camera."""
    rates_hz = _over_light(PRESETS["davis346_noisy"], seed)
    data = (
        Datum("dim light, beside our largest rate", 10.0, max(rates_hz), _HZ, "factor", _FACTOR, True),
        Datum("leak, ours in light 1", 0.2, rates_hz[-1], _HZ, "factor", _FACTOR, True),
    )
    remarks = ("Noise and leak of the preset were fitted to both: no other figure of this camera is public.",)
    return Findings("dnd21", "Background of a noisy camera", "davis346_noisy", _PROTOCOL, (_DND21,), data, remarks)


def noise2params(seed: int) -> Findings:
    """Return the background of the preset imx636_noise2params over thirteen lights beside the curve of another EVK4."""
    rows = table("noise2params")
    lux_at_reference = float(sunlight_lux(IMX636_W_M2))
    ours = [
        counts(PRESETS["imx636_noise2params"], _SUN_LUX * row["lux"] / lux_at_reference, seed).mean(axis=1) / _SECONDS
        for row in rows
    ]
    return Findings(
        name="noise2params",
        title="Noise over light of another EVK4",
        sensor="imx636_noise2params",
        protocol="Still, even light for 20 s, 9600 pixels, at thirteen lights from 0.1 to 1000 lux; ON and OFF events "
        f"of all kinds. Light 1 is {lux_at_reference:.1f} lx of sunlight on the chip. Where real light was measured "
        f"and its spectrum are not stated: one lux is taken for {_SUN_LUX:g} lx of sunlight, a number that was fitted.",
        sources=(_NOISE2PARAMS,),
        data=tuple(
            datum for row, hz in zip(rows, ours, strict=True) for datum in _rate_and_share(row, *map(float, hz))
        ),
        remarks=(
            "The real rates are those of a model that was fitted to the camera: photons counted, a threshold of 0.15 "
            "with a spread of 4.3 %, a dead time of 79 us, a leak that grows with light, and a floor.",
            "Scale of light, noise and floor of the preset were fitted to the rates, the floor to those of ON and OFF "
            "apart: of the shares only those below 100 lux are predictions, of which 5 of 9 are within the bound.",
            "Our noise is Gaussian and the thresholds are nearly equal, so about half of its events are ON; the model "
            "of this camera has 27 % at 20 lux.",
            "The floor of this camera is 0.041 Hz, that of the EVK4 of the quiet recording 0.0034 Hz: two cameras of "
            "one type differ by x 12 there, far more than the bound.",
        ),
        draw=partial(_draw, rows, ours),
    )


def _rate_and_share(row: Row, off_hz: float, on_hz: float) -> tuple[Datum, Datum]:
    real_hz, ours_hz, lux = row["on_hz"] + row["off_hz"], on_hz + off_hz, f"{row['lux']:g} lux"
    share = on_hz / ours_hz if ours_hz else float("nan")
    return (
        Datum(f"rate at {lux}", real_hz, ours_hz, _HZ, "factor", _FACTOR, True),
        Datum(f"ON share at {lux}", row["on_hz"] / real_hz, share, "", "difference", 0.1, False),
    )


def _draw(rows: tuple[Row, ...], ours: list[npt.NDArray[np.float64]], stem: Path) -> list[Path]:
    figure, [[one]] = panels(1, 1, 6.0, 4.2)
    lux = [row["lux"] for row in rows]
    for k, (name, colour) in enumerate((("off", BLUE), ("on", RED))):
        one.loglog(lux, [row[f"{name}_hz"] for row in rows], "o", color=colour, label=f"{name.upper()}, real")
        one.loglog(lux, [max(rates[k], 1e-5) for rates in ours], "-", color=colour, label=f"{name.upper()}, ours")
    one.set(xlabel="light on the chip, lux", ylabel="rate of a pixel, Hz")
    one.legend(frameon=False)
    return save(figure, stem)
