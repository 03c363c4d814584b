"""A run's second camera: its frames, its sensor and its ledger. Both cameras are drawn at the same instants."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TypeVar

from emulator.light import SceneFrames
from emulator.run.changes import BiasFollowing, Changes
from emulator.run.outcome import Ledger, LinkLedger
from emulator.run.readings import ReadingSources, StepOutput
from emulator.sensor.sensor import EventSource
from firmware_protocol.events import Events
from transports.link.report import CameraSettings, LinkReport

_T = TypeVar("_T")


class SecondView:
    """The second camera of a run, step by step.

    Attributes
    ----------
    links : names of the links that carry it.
    """

    def __init__(
        self, frames: SceneFrames, sensor: EventSource, readings: ReadingSources, links: Sequence[str]
    ) -> None:
        self._frames, self._sensor, self._readings = frames, sensor, readings
        self._biases = BiasFollowing(sensor)
        self.links = frozenset(links)

    def begin(self) -> None:
        """Draw the first light frame."""
        frame = self._frames.draw(0)
        self._sensor.reset(frame)
        self._readings.reset(frame)

    def step(self, t_ns: int) -> StepOutput:
        """Move to `t_ns` and return the events and readings until then."""
        frame = self._frames.draw(t_ns)
        readings = self._readings.read(frame)
        return StepOutput(self._sensor.expose(frame), readings)

    def finish(self) -> Events:
        """Return the events that the read-out still holds."""
        return self._sensor.finish()

    def record_in(self, changes: Changes) -> None:
        """Record the changes that its hosts make to its sensor."""
        self._biases.changes = changes

    def follow(self, settings: Mapping[str, CameraSettings], t_ns: int = 0) -> None:
        """Apply the biases that its hosts write to its sensor, which is at stream time `t_ns`."""
        self._biases.follow(self._own(settings), t_ns)

    def ledger(self, reports: Mapping[str, LinkReport]) -> Ledger:
        """Return the fates of its events."""
        return ledger_of(self._sensor, self._own(reports))

    def _own(self, of_links: Mapping[str, _T]) -> dict[str, _T]:
        return {name: one for name, one in of_links.items() if name in self.links}

    def close(self) -> None:
        """Close its scene."""
        self._frames.scene.close()


def ledger_of(sensor: EventSource | Ledger, reports: Mapping[str, LinkReport], second: Ledger | None = None) -> Ledger:
    """Return the fates of the events of a sensor over its links."""
    return Ledger(
        raised=sensor.raised,
        lost_in_pixel=sensor.lost_in_pixel,
        lost_at_readout=sensor.lost_at_readout,
        read_out=sensor.read_out,
        links=tuple(
            LinkLedger(name, report.delivered, report.dropped, report.dropped_in_device)
            for name, report in reports.items()
        ),
        second=second,
    )
