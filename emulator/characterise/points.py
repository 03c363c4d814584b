"""Points of a measured curve, beside the values of the pixel's equations."""

from __future__ import annotations

import math
from dataclasses import dataclass

__all__ = ["CURVES", "FIGURE", "Curve", "Point"]

FIGURE = "figure"
"""The curve of points that are single figures: named by their series, drawn nowhere."""


@dataclass(frozen=True, slots=True)
class Point:
    """One measured value.

    Attributes
    ----------
    curve : str
        A key of `CURVES`, or `FIGURE`.
    series : str
        Line of the curve.
    x, y : float
        In the curve's units.
    low, high : float
        Spread between pixels or events, 5 % and 95 %; NaN: none.
    model : float
        Value of the equations; NaN: no closed form.
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
    """How a curve is drawn: its words, its axes, the chart that it is a panel of, and the least value worth a mark."""

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
    "noise_law": Curve("noise", "Law of noise events", "threshold over noise", "ON rate over bandwidth", False),
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
