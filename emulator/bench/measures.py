"""What `evstim bench` measures: names, units, and where each is measured."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from emulator.bench import link, pixel, scene, word

__all__ = ["MEASURES", "Measure"]


@dataclass(frozen=True)
class Measure:
    """One figure. `run` takes seconds and returns a median of several repeats, in `unit`."""

    name: str
    unit: str
    better: Literal["higher", "lower"]
    target: float
    run: Callable[[], float]


MEASURES = (
    Measure("pixel_quiet", "Mpixel/s", "higher", 1000, pixel.pixel_quiet),
    Measure("pixel_5pct", "Mpixel/s", "higher", 500, pixel.pixel_5pct),
    Measure("words_encode", "Mev/s", "higher", 80, word.words_encode),
    Measure("words_decode", "Mev/s", "higher", 40, word.words_decode),
    Measure("checkerboard_346x260", "frames/s", "higher", 2000, scene.checkerboard_346x260),
    Measure("checkerboard_1280x720", "frames/s", "higher", 200, scene.checkerboard_1280x720),
    Measure("eros_346x260", "frames/s", "higher", 150, scene.eros_346x260),
    Measure("eros_1280x720", "frames/s", "higher", 60, scene.eros_1280x720),
    Measure("usbip_events", "Mev/s", "higher", 12, link.usbip_events),
    Measure("latency_p50", "us", "lower", 2000, link.latency_p50),
    Measure("latency_p99", "us", "lower", 5000, link.latency_p99),
)
