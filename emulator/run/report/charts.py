"""The charts of a run's report, as SVG files' text and PNG data, drawn by matplotlib."""

from __future__ import annotations

import base64
import io
from typing import Any

import numpy as np

from emulator.report.figures import pyplot
from emulator.run.report.observation import INTERVAL_EDGES_US, Observation

__all__ = ["interval_chart", "pixel_map", "rate_chart"]

_ON, _OFF, _BOTH = "#d55e00", "#0072b2", "#333333"  # told apart by colour-blind people too


def rate_chart(seen: Observation, seconds: float) -> str:
    """Return the event rate over the whole bins of stream time in a run of `seconds`, an <svg> element."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 2.6))
    bin_s = seen.rates.bin_us * 1e-6
    whole = max(1, int(seconds / bin_s + 1e-9))
    on, every = seen.rates.on[:whole], seen.rates.events[:whole]
    edges_s = np.arange(len(every) + 1) * bin_s
    axes.stairs(on / bin_s * 1e-3, edges_s, color=_ON, label="ON")
    axes.stairs((every - on) / bin_s * 1e-3, edges_s, color=_OFF, label="OFF")
    axes.set(xlabel="stream time, s", ylabel="kev/s", title=f"event rate, in bins of {bin_s:g} s")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    return _svg(figure)


def interval_chart(seen: Observation) -> str:
    """Return the histogram of intervals between events of one pixel, an <svg> element."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 2.6))
    axes.stairs(seen.intervals, INTERVAL_EDGES_US, color=_BOTH)
    axes.set(xscale="log", xlabel="us", ylabel="intervals", title="time between two events of a pixel (1 pixel in 8)")
    return _svg(figure)


def pixel_map(seen: Observation) -> str:
    """Return the events of each pixel as an <img> element that holds its own data."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 5))
    shown = axes.imshow(np.log10(1 + seen.on + seen.off), cmap="cividis", interpolation="nearest")
    figure.colorbar(shown, ax=axes, label="log10(1 + events)")
    axes.set_title("events of each pixel")
    data = io.BytesIO()
    figure.savefig(data, format="png", dpi=100, bbox_inches="tight")
    plt.close(figure)
    return f'<img alt="events of each pixel" src="data:image/png;base64,{base64.b64encode(data.getvalue()).decode()}">'


def _svg(figure: Any) -> str:
    text = io.StringIO()
    figure.savefig(text, format="svg", bbox_inches="tight")
    pyplot().close(figure)
    return text.getvalue()[text.getvalue().index("<svg") :]
