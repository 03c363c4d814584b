"""The sensor follows the biases that hosts write to their cameras while the run goes on.

    host --bias word--> device --sensor_factors--> LinkReport --> BiasFollowing --> sensor.adjust

A factor is one at the default words. What a slider, or another link, made of a figure before stays in it: a change of
a factor multiplies the present figure by new factor / old factor.
"""

from __future__ import annotations

import logging
from collections.abc import Mapping
from typing import Any

from emulator.sensor.event_source import AdjustableSource
from transports.link.report import LinkReport

__all__ = ["BiasFollowing"]

log = logging.getLogger("evstim")


class BiasFollowing:
    """Adjusts a sensor by what links report; `sensor` may be one that cannot be adjusted."""

    def __init__(self, sensor: Any) -> None:
        self._sensor = sensor if isinstance(sensor, AdjustableSource) else None
        self._factors: dict[str, Mapping[str, float]] = {}

    def follow(self, reports: Mapping[str, LinkReport]) -> None:
        """Adjust the sensor where the factors of a link have changed."""
        for link, report in reports.items():
            before = self._factors.get(link, {})
            if self._sensor is not None and report.sensor_factors != before and not report.final:
                self._factors[link] = report.sensor_factors
                self._adjust(link, before, report.sensor_factors)

    def _adjust(self, link: str, before: Mapping[str, float], now: Mapping[str, float]) -> None:
        assert self._sensor is not None
        figures = self._sensor.adjustable
        for name in sorted({*before, *now} & set(figures)):
            ratio = now.get(name, 1.0) / before.get(name, 1.0)
            if ratio == 1.0:
                continue
            try:
                self._sensor.adjust(name, figures[name] * ratio)
                log.info("%s: biases make %s %.4g", link, name, figures[name] * ratio)
            except ValueError as error:
                log.warning("%s: the biases are beyond what the sensor models: %s", link, error)
