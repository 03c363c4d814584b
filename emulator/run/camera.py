"""A camera of a run: its light frames, its sensor, its readings beside events, and the links that carry it.

A run has one camera or two; both are drawn at the same instants. Readings are frames and samples of an inertial unit:

    ReadingSource --records--> a ReadingRing for each link --> device
                  <--settings-- of the first link whose host has switched this kind on

There is one chip: where the hosts of several links request different exposures, the first link decides, and the others
receive its frames.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from emulator.light import LightFrame, SceneFrames
from emulator.run.changes import BiasFollowing, Changes
from emulator.run.outcome import Ledger, LinkLedger
from emulator.sensor.sensor import EventSource
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.events import Events
from transports.link.process import LinkSetup
from transports.link.report import CameraSettings, LinkReport
from transports.link.rings import ReadingRing

_CAPACITY = {ReadingKind.FRAMES: 4096, ReadingKind.IMU: 16384}


class ReadingSource(Protocol):
    """Source of readings of one kind, from light and time.

    Attributes
    ----------
    kind, record : of its readings; the dtype has a field `t`, us of stream time.
    """

    kind: ReadingKind
    record: np.dtype[Any]

    def reset(self, frame: LightFrame) -> None:
        """Start at the time of `frame`."""

    def read(self, frame: LightFrame, settings: tuple[int, ...]) -> Readings:
        """Move to the time of `frame` and return the readings until then, sorted.

        `settings` are the numbers in the camera's registers; empty before a host has written any.
        """


class ReadingSources:
    """The sources of a run, and the rings to its links.

    Parameters
    ----------
    setups : of the run's links; each with the rings that `new_rings` made for it.
    settings : of each kind, where no host has switched it on; none: there are no readings then.
    """

    def __init__(
        self,
        sources: Sequence[ReadingSource],
        setups: Sequence[LinkSetup[Any]],
        settings: Mapping[ReadingKind, tuple[int, ...]] | None = None,
    ) -> None:
        self._sources, self._without_host = sources, settings or {}
        self._rings = {
            source.kind: [ring for setup in setups for ring in setup.readings if ring.kind == source.kind]
            for source in sources
        }

    @staticmethod
    def new_rings(sources: Sequence[ReadingSource]) -> tuple[ReadingRing, ...]:
        """Return new rings for one link, one for each source."""
        return tuple(ReadingRing(source.kind, source.record, _CAPACITY[source.kind]) for source in sources)

    def reset(self, frame: LightFrame) -> None:
        """Start all at the time of `frame`."""
        for source in self._sources:
            source.reset(frame)

    def read(self, frame: LightFrame) -> list[tuple[ReadingKind, Readings]]:
        """Move all to the time of `frame` and return the readings of each until then."""
        return [(source.kind, source.read(frame, self._settings(source.kind))) for source in self._sources]

    def _settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Return the settings of the first link whose first number, `run`, is not zero."""
        switched_on = (settings for ring in self._rings[kind] if (settings := ring.settings) and settings[0])
        return next(switched_on, self._without_host.get(kind, ()))


@dataclass(frozen=True)
class StepOutput:
    """Events (n,) EVENT, and readings by their kind, each sorted by time, us of stream time."""

    events: Events
    readings: Sequence[tuple[ReadingKind, Readings]] = ()

    def pieces(self, t0_us: int, t1_us: int, length_us: int | None) -> Iterator[tuple[int, StepOutput]]:
        """Yield the output of a step from `t0_us` to `t1_us` in parts of this length, each with its end; None: whole.

        The last one ends later than the step where it has later events, at the run's end.
        """
        output = self
        for until_us in () if length_us is None else range(t0_us + length_us, t1_us, length_us):
            counts = [_up_to(records, until_us) for _, records in output.readings]
            n = _up_to(output.events, until_us)
            readings = list(zip(output.readings, counts, strict=True))
            yield until_us, StepOutput(output.events[:n], [(kind, records[:k]) for (kind, records), k in readings])
            output = StepOutput(output.events[n:], [(kind, records[k:]) for (kind, records), k in readings])
        yield max(t1_us, int(output.events["t"][-1])) if len(output.events) else t1_us, output


def _up_to(records: Events | Readings, until_us: int) -> int:
    return int(np.searchsorted(records["t"], np.uint64(until_us), "right"))


class CameraView:
    """One camera of a run, step by step, on the links of these names.

    `changes` is the record of the changes that its hosts make to its sensor; None for no record.
    """

    def __init__(
        self,
        frames: SceneFrames,
        sensor: EventSource,
        readings: ReadingSources,
        links: Collection[str],
        changes: Changes | None = None,
    ) -> None:
        self.frames = frames
        self.sensor = sensor
        self.readings = readings
        self.links = frozenset(links)
        self._biases = BiasFollowing(sensor, changes)

    def begin(self) -> LightFrame:
        """Draw the first light frame, and start sensor and readings with it."""
        frame = self.frames.draw(0)
        self.sensor.reset(frame)
        self.readings.reset(frame)
        return frame

    def step(self, t_ns: int) -> StepOutput:
        """Move to `t_ns` and return the events and readings until then."""
        frame = self.frames.draw(t_ns)
        readings = self.readings.read(frame)
        return StepOutput(self.sensor.expose(frame), readings)

    def record_in(self, changes: Changes) -> None:
        """Record the changes that its hosts make to its sensor."""
        self._biases.changes = changes

    def follow(self, link: str, settings: CameraSettings, t_ns: int = 0) -> None:
        """Apply the biases that the host of a link writes to its sensor, which is at stream time `t_ns`."""
        if link in self.links:
            self._biases.follow(link, settings, t_ns)

    def ledger(self, reports: Mapping[str, LinkReport], second: Ledger | None = None) -> Ledger:
        """Return the fates of its events; `second`: those of a second camera."""
        links = tuple(
            LinkLedger(name, report.delivered, report.dropped, report.dropped_in_device)
            for name, report in reports.items()
            if name in self.links
        )
        return Ledger(
            raised=self.sensor.raised,
            lost_in_pixel=self.sensor.lost_in_pixel,
            lost_at_readout=self.sensor.lost_at_readout,
            read_out=self.sensor.read_out,
            links=links,
            second=second,
        )

    def ledger_if_it_ends(self) -> Ledger:
        """Return the fates of its events if it gives none from now on: those that wait are lost at the read-out."""
        ledger = self.ledger({})
        return dataclasses.replace(ledger, lost_at_readout=ledger.raised - ledger.lost_in_pixel - ledger.read_out)
