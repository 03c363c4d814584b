"""The report of a link: its state, the fates of its events and edges, and what its faults did."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.device.event_device import CameraCounters
from transports.faults.script import FaultRecord
from transports.link.deliveries import LatencySummary
from transports.link.endpoint import LineUse
from transports.link.feed import ClockReport, EdgeReport, ReadingReport
from transports.recording.summary import RecordingSummary

__all__ = ["LinkReport"]


@dataclass(frozen=True)
class LinkReport:
    """What a link has done so far.

    Attributes
    ----------
    digest
        Of the events delivered since the camera's clock was last zero, in device time; see `digest_of`.
    error
        Set when the link could not start or had to give up.
    use
        How full the line was, where it has a capacity.
    counts
        What else happened on this kind of link, by name.
    edges
        What became of edges before the camera took them.
    clock
        How wrong the camera's own clock is, where it is modelled.
    faults
        What each fault injected so far has done. What they destroyed is in `dropped`; the camera's own counters, which
        cannot know of it, have it as delivered.
    file_troubles
        Why a file of the link (record, truth, fault log) is not whole, a sentence each.
    sensor_factors
        What the host's biases multiply figures of the sensor by; see `EventDevice.sensor_factors`.
    without_effect
        Settings of the host that change nothing in the sensor, and why; see `EventDevice.without_effect`.
    readings
        What became of frames and samples before the camera took them, by kind.
    recordings
        What the files that the link writes hold: its record, and its own.
    """

    state: str
    address: str | None = None
    delivered: int = 0
    dropped: int = 0
    camera: CameraCounters | None = None
    latency: LatencySummary = field(default_factory=LatencySummary)
    digest: int = 0
    final: bool = False
    error: str | None = None
    use: LineUse | None = None
    counts: Mapping[str, int] = field(default_factory=dict)
    edges: EdgeReport = field(default_factory=EdgeReport)
    clock: ClockReport | None = None
    faults: tuple[FaultRecord, ...] = ()
    file_troubles: tuple[str, ...] = ()
    sensor_factors: Mapping[str, float] = field(default_factory=dict)
    without_effect: Mapping[str, str] = field(default_factory=dict)
    readings: Mapping[str, ReadingReport] = field(default_factory=dict)
    recordings: tuple[RecordingSummary, ...] = ()

    @property
    def dropped_in_device(self) -> int:
        """Events that the camera took and did not hand to the link."""
        return 0 if self.camera is None else self.camera.dropped_in_device

    @property
    def edges_balanced(self) -> bool:
        """True when every edge has one fate."""
        if self.camera is None:
            return True
        edges = self.camera.edges
        return edges.offered == self.edges.taken and edges.accounted == edges.offered + edges.added

    @property
    def readings_balanced(self) -> bool:
        """True when every reading that the camera took has one fate."""
        if self.camera is None:
            return True
        taken = {kind: report.taken for kind, report in self.readings.items() if report.taken}
        counted = self.camera.readings
        return taken == {kind: c.offered for kind, c in counted.items() if c.offered} and all(
            c.accounted == c.offered for c in counted.values()
        )
