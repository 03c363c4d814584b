"""The sensor follows the biases that hosts write to their cameras while the run goes on.

    host --bias word--> device --CameraSettings, with their stream time--> BiasFollowing --> sensor.adjust

A factor is one at the default words. What a slider made of a figure before stays in it: a change of the factors
multiplies the present figure by new product / old product. The product is that over all links, and it is kept within
the bounds that one link's factor has: a camera has one set of pixels, however many hosts set their biases.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from typing import Any

from emulator.run.changes import Change, Changes
from emulator.sensor.event_source import AdjustableSource
from firmware_protocol.davis346.bias_effects import LEAST_FACTOR, MOST_FACTOR
from transports.link.changes import CameraSettings

__all__ = ["BiasFollowing"]

log = logging.getLogger(__name__)


class BiasFollowing:
    """Adjusts a sensor by what its cameras report, and says in the log what is adjusted and what cannot be.

    `sensor` may be one that cannot be adjusted.

    Attributes
    ----------
    changes : where what is adjusted is recorded; None: nowhere.
    """

    def __init__(self, sensor: Any, changes: Changes | None = None) -> None:
        self._sensor = sensor if isinstance(sensor, AdjustableSource) else None
        self.changes = changes
        self._accepted: dict[str, dict[str, float]] = {}
        self._applied: dict[str, float] = {}
        self._heard: dict[str, Mapping[str, float]] = {}
        self._without_effect: dict[str, Mapping[str, str]] = {}

    def follow(self, settings: Mapping[str, CameraSettings], t_ns: int = 0) -> None:
        """Adjust the sensor, which is at stream time `t_ns`, where the factors of a link have changed."""
        for link, one in settings.items():
            self._tell(link, one.without_effect)
            if one.sensor_factors != self._heard.get(link, {}):
                self._heard[link] = one.sensor_factors
                self._adjust(link, one, t_ns)

    def _tell(self, link: str, without_effect: Mapping[str, str]) -> None:
        """Say which settings have come to be without effect."""
        before, self._without_effect[link] = self._without_effect.get(link, {}), without_effect
        for name, why in without_effect.items():
            if name not in before:
                log.warning("%s: bias %s has no effect: %s", link, name, why)

    def _adjust(self, link: str, settings: CameraSettings, t_ns: int) -> None:
        """Bring the figures to their new factors; one that cannot follow keeps the factor that it had."""
        figures = {} if self._sensor is None else self._sensor.adjustable
        accepted, wanted = self._accepted.setdefault(link, {}), settings.sensor_factors
        for name in sorted({*accepted, *wanted}):
            factor = wanted.get(name, 1.0)
            if factor == accepted.get(name, 1.0):
                continue
            if name not in figures:
                log.warning("%s: biases have no effect on %s: this source of events cannot change it", link, name)
                continue
            product = self._product(link, name, factor)
            value = figures[name] * product / self._applied.get(name, 1.0)
            if value == figures[name] or self._set(link, name, value):
                accepted[name], self._applied[name] = factor, product
                self._record(link, settings, t_ns, name, (figures[name], value))

    def _product(self, link: str, name: str, factor: float) -> float:
        """Return the product of all links' factors with a new one of `link`, within the bounds of one."""
        others = (one.get(name, 1.0) for other, one in self._accepted.items() if other != link)
        product = factor * math.prod(others)
        bounded = min(max(product, LEAST_FACTOR), MOST_FACTOR)
        if bounded != product:
            log.warning("%s: biases of all links make %s %.4g times as large: kept at %g", link, name, product, bounded)
        return bounded

    def _set(self, link: str, name: str, value: float) -> bool:
        assert self._sensor is not None
        try:
            self._sensor.adjust(name, value)
        except ValueError as error:
            log.warning("%s: the biases are beyond what the sensor models: %s", link, error)
            return False
        log.info("%s: biases make %s %.4g", link, name, value)
        return True

    def _record(self, link: str, settings: CameraSettings, t_ns: int, name: str, values: tuple[float, float]) -> None:
        if self.changes is not None and values[0] != values[1]:
            self.changes.add(Change(t_ns, settings.by, name, link, *values, settings.t_us))
