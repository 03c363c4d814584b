"""Background events over light: rates of a preset in still, even light, ON and OFF apart, beside published figures."""

from __future__ import annotations

import dataclasses

import numpy as np

from emulator.light import LightFrame
from emulator.sensor.presets import PRESETS, SensorParameters
from emulator.sensor.sensor import Sensor
from laboratory.validation.findings import Datum, Findings, Source

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

_LUX = (0.1, 1.0, 10.0, 100.0, 161.0, 1000.0)
_LUX_AT_REFERENCE = 1000.0  # the DVS's corner of 3 kHz at light 1 is that at 1 klux of scene light
_WIDTH, _HEIGHT, _SECONDS = 120, 80, 20
_NO_LIGHT_KNOWN = "the other sensor's type and biases are not stated: shown, not judged"


def rates_hz(p: SensorParameters, light: float, seed: int, seconds: float = _SECONDS) -> tuple[float, float]:
    """Return the ON and OFF rates of a pixel in still light, Hz, of an array of 9600 pixels."""
    p = dataclasses.replace(p, width=_WIDTH, height=_HEIGHT)
    sensor, still = Sensor(p, seed), np.full((_HEIGHT, _WIDTH), light, np.float32)
    sensor.reset(LightFrame(0, still))
    steps = [sensor.expose(LightFrame(round(k * 0.1e9), still)) for k in range(1, round(seconds * 10) + 1)]
    events = np.concatenate([*steps, sensor.finish()])
    on = int(events["on"].sum())
    return on / (_WIDTH * _HEIGHT * seconds), (len(events) - on) / (_WIDTH * _HEIGHT * seconds)


def background(seed: int) -> Findings:
    """Measure the background of the preset davis346 over light."""
    p = PRESETS["davis346"]
    data = []
    for lux in _LUX:
        for name, ours in zip(("ON", "OFF"), rates_hz(p, lux / _LUX_AT_REFERENCE, seed), strict=True):
            real = {(161.0, "ON"): 0.08, (161.0, "OFF"): 0.0003}.get((lux, name), float("nan"))
            remark = _NO_LIGHT_KNOWN if real > 0 else "no published figure at this light: shown, not judged"
            data.append(Datum(f"{name} at {lux:g} lux", real, ours, "Hz a pixel", "factor", float("nan"), remark))
    on_hz, off_hz = rates_hz(p, 1.0, seed)
    data.append(
        Datum("still pixels of the street, mid level", 0.0029, on_hz + off_hz, "Hz a pixel", "factor", 1.5,
              "light in units of the frame's level 80")
    )  # fmt: skip
    dim_hz = max(sum(rates_hz(p, lux / _LUX_AT_REFERENCE, seed)) for lux in (0.1, 1.0, 10.0, 50.0))
    data.append(
        Datum("dim light, shot noise of another DAVIS346", 10.0, dim_hz, "Hz a pixel", "factor", float("nan"),
              "its light and biases are not stated; still pixels of the recording have 0.0004 Hz in the dark")
    )  # fmt: skip
    return Findings(
        name="background",
        title="Background events over light",
        sensor="davis346",
        protocol="Still, even light for 20 s, 9600 pixels; ON and OFF events of all kinds, hot pixels included. Scene "
        "light of 1000 lux is taken as light 1.",
        sources=(_IEBCS, _DND21, _STREET),
        data=tuple(data),
        remarks=(
            "The background of the IMX636 over light is the column `opposite` of NIST's table, in its own experiment.",
            "IEBCS's pixels are leak-like, nearly all ON, and 35 % of their events come from five of 2500 pixels.",
        ),
    )
