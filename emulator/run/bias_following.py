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

log = logging.getLogger(__name__)


class BiasFollowing:
    """Adjusts a sensor by what links report, and says in the log what is adjusted and what cannot be.

    `sensor` may be one that cannot be adjusted.
    """

    def __init__(self, sensor: Any) -> None:
        self._sensor = sensor if isinstance(sensor, AdjustableSource) else None
        self._heard: dict[str, Mapping[str, float]] = {}
        self._applied: dict[str, dict[str, float]] = {}
        self._without_effect: dict[str, Mapping[str, str]] = {}

    def follow(self, reports: Mapping[str, LinkReport]) -> None:
        """Adjust the sensor where the factors of a link have changed."""
        for link, report in reports.items():
            if report.final:
                continue
            self._tell(link, report.without_effect)
            if report.sensor_factors != self._heard.get(link, {}):
                self._heard[link] = report.sensor_factors
                self._adjust(link, report.sensor_factors)

    def _tell(self, link: str, without_effect: Mapping[str, str]) -> None:
        """Say which settings have come to be without effect."""
        before, self._without_effect[link] = self._without_effect.get(link, {}), without_effect
        for name, why in without_effect.items():
            if name not in before:
                log.warning("%s: bias %s has no effect: %s", link, name, why)

    def _adjust(self, link: str, wanted: Mapping[str, float]) -> None:
        """Bring the figures to their new factors; one that cannot follow keeps the factor that it had."""
        figures = {} if self._sensor is None else self._sensor.adjustable
        applied = self._applied.setdefault(link, {})
        for name in sorted({*applied, *wanted}):
            factor = wanted.get(name, 1.0)
            ratio = factor / applied.get(name, 1.0)
            if ratio == 1.0:
                continue
            if name not in figures:
                log.warning("%s: biases have no effect on %s: this source of events cannot change it", link, name)
            elif self._set(link, name, figures[name] * ratio):
                applied[name] = factor

    def _set(self, link: str, name: str, value: float) -> bool:
        assert self._sensor is not None
        try:
            self._sensor.adjust(name, value)
        except ValueError as error:
            log.warning("%s: the biases are beyond what the sensor models: %s", link, error)
            return False
        log.info("%s: biases make %s %.4g", link, name, value)
        return True
