"""Report of a link: its state, the fates of its events and edges, and the effects of its faults."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.device.fates import Fates
from transports.faults.script import FaultRecord
from transports.link.deliveries import LatencySummary
from transports.link.endpoint import LineUse
from transports.link.feed import ClockReport, EdgeReport, ReadingReport
from transports.recording.summary import RecordingSummary

__all__ = ["LinkReport"]


@dataclass(frozen=True)
class LinkReport:
    """State and counts of a link.

    Attributes
    ----------
    digest
        Digest of the events delivered since the camera's clock was last zero, in device time; see `digest_of`.
    error
        Set when the link could not start or had to stop.
    use
        Load of the line, if it has a limited capacity.
    counts
        Further counts of this kind of link, by name.
    edges
        Counts of the edges before the camera took them.
    clock
        Error of the camera's own clock, if it is modelled.
    faults
        Effects of each fault injected so far. Events that they destroyed are in `dropped`; the camera's own counters,
        which do not include faults of the link, have them as delivered.
    file_troubles
        Reasons for incomplete files of the link (record, truth, fault log), a sentence each.
    sensor_factors
        Factors on parameters of the sensor from the host's biases; see `EventDevice.sensor_factors`.
    without_effect
        Settings of the host that change nothing in the sensor, and why; see `EventDevice.without_effect`.
    readings
        Counts of frames and samples before the camera took them, by kind.
    recordings
        Summaries of the files that the link writes: its record, and its own.
    """

    state: str
    address: str | None = None
    delivered: int = 0
    dropped: int = 0
    camera: Fates | None = None
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
        """Number of events that the camera took and did not pass to the link."""
        return 0 if self.camera is None else self.camera.dropped_in_device

    @property
    def edges_balanced(self) -> bool:
        """True when every edge has one fate."""
        if self.camera is None:
            return True
        edges = self.camera.edges
        return edges.offered == self.edges.taken and edges.balanced

    @property
    def readings_balanced(self) -> bool:
        """True when every reading that the camera took has one fate."""
        if self.camera is None:
            return True
        taken = {kind: report.taken for kind, report in self.readings.items() if report.taken}
        counted = self.camera.readings
        return taken == {kind: c.offered for kind, c in counted.items() if c.offered} and all(
            c.balanced for c in counted.values()
        )
