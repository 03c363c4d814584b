"""Record of changes to a run from outside: origin, value, and the stream time from which each acts.

A host writes a register or sends a telecommand, a viewer of the live page moves a slider, `evstim fault` begins a
fault. The run then no longer follows from its rig and its seed alone. With this record it can be repeated.

The sensor follows the biases that hosts write to their cameras while the run goes on.

    host --bias word--> device --CameraSettings, with their stream time--> BiasFollowing --> sensor.adjust

`transports.link.report` has the first half of this way.

A factor is one at the default words. A change of the factors multiplies the present parameter by new product / old
product, so that an earlier change by a slider stays. The product is that over all links, limited to the bounds of one
link's factor, because a camera has one set of pixels, however many hosts set their biases. The high-pass has a sum in
its place, which is 0 at the default words.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from emulator.sensor.sensor import AdjustableSource
from firmware_protocol.device import LEAST_FACTOR, MOST_FACTOR
from transports.link.report import ADDED_FACTORS, CameraSettings

log = logging.getLogger(__name__)

_MOST = 10_000


@dataclass(frozen=True)
class Change:
    """One change.

    Attributes
    ----------
    t_ns : stream time from which it acts: for a sensor parameter, the end of a step.
    by
        "register", "telecommand", "restart" of a link; "live page", "evstim" (its verbs fault and trigger), "program".
    link : the link over which it came, or that it concerns; empty for none.
    what : a sensor parameter such as "threshold_on"; a fault, an edge of `evstim trigger`, a telecommand.
    before, after : values of the parameter; None where there are none.
    taken_us : stream time of the camera when it received the change; None where no camera received it.
    fault : number of the fault on its link that begins or ends; 0 for none.
    """

    t_ns: int
    by: str
    what: str
    link: str = ""
    before: float | None = None
    after: float | None = None
    taken_us: int | None = None
    fault: int = 0

    def as_json(self) -> dict[str, object]:
        """Return the object that `evstim run --json` prints."""
        return {
            "t_us": self.t_ns / 1000, "by": self.by, "link": self.link, "what": self.what,
            "before": self.before, "after": self.after, "taken_us": self.taken_us,
            **({"fault": self.fault} if self.fault else {}),
        }  # fmt: skip

    @property
    def text(self) -> str:
        """Return a line for people."""
        whose = f"{self.link}: " if self.link else ""
        values = "" if self.after is None else f" {self.before:.4g} -> {self.after:.4g}"
        return f"{self.t_ns * 1e-9:.6f} s: {whose}{self.what}{values} ({self.by})"


class Changes:
    """The changes of a run; from 10 000 on they are not listed, and only counted in `beyond`."""

    def __init__(self) -> None:
        self._listed: list[Change] = []
        self.beyond = 0

    def add(self, change: Change) -> None:
        """Add one."""
        if len(self._listed) < _MOST:
            self._listed.append(change)
        else:
            self.beyond += 1

    @property
    def in_order(self) -> tuple[Change, ...]:
        """Listed changes in the order in which they came; this never changes, so that its indices are names."""
        return tuple(self._listed)

    @property
    def listed(self) -> tuple[Change, ...]:
        """Listed changes, sorted by the stream time from which they act."""
        return tuple(sorted(self._listed, key=lambda change: change.t_ns))


class BiasFollowing:
    """Adjustment of a sensor by the biases that its cameras report, with a log line for each result.

    `sensor` may be one that cannot be adjusted; `changes` is the record of the adjustments, None for no record.
    """

    def __init__(self, sensor: Any, changes: Changes | None = None) -> None:
        self._sensor = sensor if isinstance(sensor, AdjustableSource) else None
        self.changes = changes
        self._accepted: dict[str, dict[str, float]] = {}
        self._applied: dict[str, float] = {}
        self._factors_of: dict[str, Mapping[str, float]] = {}
        self._without_effect: dict[str, Mapping[str, str]] = {}

    def follow(self, link: str, settings: CameraSettings, t_ns: int = 0) -> None:
        """Adjust the sensor, which is at stream time `t_ns`, where the factors of a link have changed."""
        before, self._without_effect[link] = self._without_effect.get(link, {}), settings.without_effect
        for name, reason in settings.without_effect.items():
            if name not in before:
                log.warning("%s: bias %s has no effect: %s", link, name, reason)
        if settings.sensor_factors != self._factors_of.get(link, {}):
            self._factors_of[link] = settings.sensor_factors
            self._adjust(link, settings, t_ns)

    def _adjust(self, link: str, settings: CameraSettings, t_ns: int) -> None:
        """Set the parameters to their new factors; one that cannot follow keeps its old factor."""
        sensor = self._sensor
        accepted = self._accepted.setdefault(link, {})
        factors = settings.sensor_factors
        for name in sorted({*accepted, *factors}):
            neutral = 0.0 if name in ADDED_FACTORS else 1.0
            factor = factors.get(name, neutral)
            if factor == accepted.get(name, neutral):
                continue
            if sensor is None or name not in sensor.adjustable:
                log.warning("%s: biases have no effect on %s: this source of events cannot change it", link, name)
                continue
            total = self._total(link, name, factor)
            before, applied = sensor.adjustable[name], self._applied.get(name, neutral)
            value = max(round(before + total - applied, 9), 0.0) if name in ADDED_FACTORS else before * total / applied
            if value != before:
                try:
                    sensor.adjust(name, value)
                except ValueError as error:
                    log.warning("%s: the biases are beyond the sensor's model: %s", link, error)
                    continue
                log.info("%s: biases make %s %.4g", link, name, value)
                if self.changes is not None:
                    self.changes.add(Change(t_ns, settings.by, name, link, before, value, settings.t_us))
            accepted[name] = factor
            self._applied[name] = total

    def _total(self, link: str, name: str, factor: float) -> float:
        """Return the sum, or the product within the bounds of one, of all links' factors with a new one of `link`."""
        accepted = (factors[name] for other, factors in self._accepted.items() if other != link and name in factors)
        if name in ADDED_FACTORS:
            return factor + sum(accepted)
        product = factor * math.prod(accepted)
        bounded = min(max(product, LEAST_FACTOR), MOST_FACTOR)
        if bounded != product:
            log.warning(
                "%s: biases of all links make %s %.4g times as large: limited to %g", link, name, product, bounded
            )
        return bounded
