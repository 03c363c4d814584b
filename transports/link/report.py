"""Messages of a link to its session: its report, and the changes of its camera by hosts and users.

    host --bias, telecommand--> device --> ChangeWatch --CameraSettings, Occurrence--> session
    user --fault, edge by hand-----------> ChangeWatch -----------------Occurrence---> session

The stream time of a change is the time that the camera had reached when it accepted the change: it had processed all
events up to that time and none after it. The camera stores its stream time after it has sent its changes
(`EventRing.settle`). So when a camera has reached a stream time, a waiting session has all changes before that time. It
need not wait until the events have been sent: it computes its next step meanwhile.

A bias on its way: the register (`Fx3Camera._write`), its factor (`sensor_factors`), `ChangeWatch.look`,
`LinkLoop._send_changes`, `LinkProcess.take_changes`, `Session._follow_cameras`, `BiasFollowing.follow`
(`emulator.run.changes`), `Sensor.adjust`.
"""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.device.event_device import EventDevice, HostAdjusted
from firmware_protocol.device.fates import Fates
from firmware_protocol.recordings.part import RecordingSummary
from transports.faults.script import FaultRecord
from transports.link.deliveries import LatencySummary
from transports.link.endpoint import LineUse
from transports.link.feed import ClockReport, EdgeReport, ReadingReport

_MOST_WAITING = 1000  # changes that a busy session has not read
ADDED_FACTORS = ("highpass_hz",)  # sensor parameters to which biases add, because they may be 0

_PAUSE_NS = 2_000_000  # after the last write of a sequence; drivers write a register each 0.1 ms
_LONGEST_NS = 20_000_000


@dataclass(frozen=True)
class CameraSettings:
    """Settings of a camera that act on its sensor, valid from a stream time on.

    Attributes
    ----------
    t_us : stream time that the camera had reached.
    by : origin: "register" or "telecommand"; or "restart", when the camera has its power-on settings again.
    sensor_factors, without_effect : see `HostAdjusted`.
    """

    t_us: int
    by: str
    sensor_factors: Mapping[str, float] = field(default_factory=dict)
    without_effect: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Occurrence:
    """Any other external action on a camera: a telecommand, a fault, an edge by hand.

    Attributes
    ----------
    t_us : stream time that the camera had reached.
    by : origin: "telecommand", or the user's name for the session's request, such as "evstim".
    what : description, such as "SetRegion(x=0, y=0, width=8, height=8)", "fault stall", "trigger pulse".
    fault : number of the fault on its link that begins or ends; 0 for none.
    """

    t_us: int
    by: str
    what: str
    fault: int = 0


class ChangeWatch:
    """Detector of one device's changes; `waiting` holds them, the oldest first, until the session takes them.

    Drivers write long sequences of registers, and pixels do not follow the settings between two writes. So settings are
    `pending` until the host has written nothing for 2 ms, but not longer than 20 ms, as a host may never pause.
    """

    def __init__(self, device: EventDevice) -> None:
        self._device = device if isinstance(device, HostAdjusted) else None
        self._by = "" if self._device is None else self._device.set_by
        self._recorded = CameraSettings(0, self._by)
        self.pending: CameraSettings | None = None
        self._first_ns = self._written_ns = 0
        self._not_listed = 0
        self._version: int | None = None
        self.waiting: deque[CameraSettings | Occurrence] = deque()

    @property
    def is_behind(self) -> bool:
        """True if the device has counted a change since the last `look`, or settings are pending."""
        device = self._device
        return device is not None and (device.settings_version != self._version or self.pending is not None)

    @property
    def acts(self) -> bool:
        """True if hosts of this kind of device can change the sensor."""
        return self._device is not None

    def look(self, t_us: int, now_ns: int) -> None:
        """Record the changes since the last call, at stream time `t_us` of the camera and `now_ns` of the host."""
        device = self._device
        if device is None or not self.is_behind:
            return
        if device.settings_version != self._version:
            self._version, self._written_ns = device.settings_version, now_ns
            for command in device.take_commands():
                self.add(Occurrence(t_us, self._by, command))
            if self.pending is None:
                self._first_ns = now_ns
            factors = {k: factor for k, factor in device.sensor_factors.items() if factor != 1 or k in ADDED_FACTORS}
            self.pending = CameraSettings(t_us, self._by, factors, dict(device.without_effect))
            if dataclasses.replace(self.pending, t_us=self._recorded.t_us) == self._recorded:
                self.pending = None
        if self.pending is not None and now_ns >= min(self._written_ns + _PAUSE_NS, self._first_ns + _LONGEST_NS):
            self.add(self.pending)
            self._recorded, self.pending = self.pending, None

    def add(self, change: CameraSettings | Occurrence) -> None:
        """Record a change; if 1000 wait, occurrences are only counted, and settings replace the last ones.

        So the sensor follows the settings whatever else a host sends.
        """
        if len(self.waiting) < _MOST_WAITING:
            if self._not_listed:
                self.waiting.append(Occurrence(change.t_us, self._by, f"{self._not_listed} more, not listed"))
                self._not_listed = 0
            self.waiting.append(change)
        elif isinstance(change, Occurrence):
            self._not_listed += 1
        else:
            if isinstance(self.waiting[-1], CameraSettings):
                self.waiting.pop()
            self.waiting.append(change)


@dataclass(frozen=True)
class LinkReport:
    """State and counts of a link.

    Attributes
    ----------
    attach_command : command that attaches a host, while the link waits for one.
    digest : digest of the events delivered since the camera's clock was last zero, in device time; see `digest_of`.
    error : set when the link could not start or had to stop.
    use : load of the line, if it has a limited capacity.
    counts : further counts of this kind of link, by name.
    edges : counts of the edges before the camera took them.
    clock : error of the camera's own clock, if it is modelled.
    faults : Effects of each fault injected so far. Events that they destroyed are in `dropped`; the camera's own
        counters, which do not include faults of the link, have them as delivered.
    file_troubles : reasons for incomplete files of the link (record, truth, fault log), a sentence each.
    sensor_factors : factors on parameters of the sensor from the host's biases; see `HostAdjusted.sensor_factors`.
    without_effect : settings of the host that change nothing in the sensor, and why; see `HostAdjusted.without_effect`.
    readings : counts of frames and samples before the camera took them, by kind.
    recordings : summaries of the files that the link writes: its record, and its own.
    """

    state: str
    address: str | None = None
    attach_command: str = ""
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
