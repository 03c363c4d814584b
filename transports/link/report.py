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
_FOREVER_US = 1 << 62


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
    """Detector of one device's changes; `waiting` holds them, the oldest first, until the session takes them."""

    def __init__(self, device: EventDevice) -> None:
        self._device = device if isinstance(device, HostAdjusted) else None
        self._by = "" if self._device is None else self._device.set_by
        self._factors: dict[str, float] = {}
        self._without_effect: dict[str, str] = {}
        self._not_listed = 0
        self._version: int | None = None
        self.waiting: deque[CameraSettings | Occurrence] = deque()

    @property
    def is_behind(self) -> bool:
        """True if the device has counted a change since the last `look`."""
        return self._device is not None and self._device.settings_version != self._version

    @property
    def acts(self) -> bool:
        """True if hosts of this kind of device can change the sensor."""
        return self._device is not None

    def look(self, t_us: int) -> None:
        """Record the changes since the last call, at stream time `t_us` of the camera."""
        device = self._device
        if device is None or device.settings_version == self._version:
            return
        self._version = device.settings_version
        for command in device.take_commands():
            self.add(Occurrence(t_us, self._by, command))
        factors, without_effect = dict(device.sensor_factors), dict(device.without_effect)
        if (factors, without_effect) != (self._factors, self._without_effect):
            self._factors, self._without_effect = factors, without_effect
            self.add(CameraSettings(t_us, self._by, factors, without_effect))

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

    def settled_us(self, reached_us: int) -> int:
        """Return the stream time before which no further change of the sensor can come, for a camera at `reached_us`.

        Without limit if no action of the hosts can change the sensor.
        """
        return reached_us if self.acts else _FOREVER_US


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
