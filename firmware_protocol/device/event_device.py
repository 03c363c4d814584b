"""What any event camera is to the link that feeds it, whatever carries its bytes: USB, a serial line, a CAN bus.

    ring --events--> offer ---+
    bus  --edges---> offer_edges --> device --> its own way out: USB transfers, messages, frames
    run  --time----> advance -+
    ring --frames, samples--> offer_readings

A device is sans-I/O. Events and edges go in with stream time; each gets exactly one fate, which `counters` tells.

What a camera reads beside events: lines of a frame, samples of an inertial unit; and what became of each.

A reading is one record of a structured array that has a field `t`, u64 microseconds of stream time. Its kind says
which record that is: `frame_lines.line_record` for frames.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any, ClassVar

import numpy.typing as npt

from firmware_protocol.events import Edges, Events

__all__ = ["CameraCounters", "EdgeCounters", "EventDevice", "Reading", "ReadingCounters", "ReadingKind", "Readings"]


Readings = npt.NDArray[Any]
"""Records of one kind, shape (n,), sorted by `t`."""


class ReadingKind(StrEnum):
    """What was read."""

    FRAMES = "frames"
    IMU = "imu"


@dataclass(frozen=True)
class Reading:
    """One record of a kind, (1,) of its dtype."""

    kind: ReadingKind
    record: Readings


@dataclass(frozen=True)
class ReadingCounters:
    """Readings of one kind offered to a device since it was made, and their fates; `offered` is the sum of the others.

    Attributes
    ----------
    not_running
        Came while the host had not switched this kind on, or in the middle of a frame whose start it did not get.
    dropped
        Found no room.
    flushed
        Waited when the buffer was emptied.
    lost_on_link
        Had left the camera when the link lost them.
    queued
        Still wait.
    """

    offered: int = 0
    not_running: int = 0
    dropped: int = 0
    flushed: int = 0
    delivered: int = 0
    lost_on_link: int = 0
    queued: int = 0

    @property
    def accounted(self) -> int:
        """Readings with a fate: as many as were offered, or something is wrong."""
        return self.not_running + self.dropped + self.flushed + self.delivered + self.lost_on_link + self.queued


_FOREVER_US = 1 << 62
_NO_BOUND = 1 << 30


@dataclass(frozen=True)
class EdgeCounters:
    """Edges offered to a camera's external input since it was made, and their fates.

    `offered` and `added` together are the sum of the others.

    Attributes
    ----------
    ignored
        Seen by no detector: the camera was not running, or its registers leave this kind of edge out.
    dropped
        Detected, and lost because a buffer was full or emptied.
    lost_on_link
        Had left the camera when the link lost them.
    added
        Made by the camera beyond one for each edge offered: a rising edge may be told again as the pulse that it
        begins, and a generator makes its own.
    """

    offered: int = 0
    ignored: int = 0
    dropped: int = 0
    delivered: int = 0
    queued: int = 0
    lost_on_link: int = 0
    added: int = 0

    @property
    def accounted(self) -> int:
        """Edges with a fate: as many as were offered and added, or something is wrong."""
        return self.ignored + self.dropped + self.delivered + self.lost_on_link + self.queued


@dataclass(frozen=True)
class CameraCounters:
    """Events offered to a camera since it was made, and their fates; `offered` is the sum of the others.

    Attributes
    ----------
    not_running
        Came while no host had the camera running.
    dropped_fifo
        Found the camera's buffer full, in events or in bytes.
    flushed
        Were in the buffer when it was emptied, at a stop or when the host went away.
    lost_on_link
        Had left the camera when the link lost them.
    queued
        Still wait.
    not_selected
        Left out on purpose: outside the region of interest, or a pixel that sub-sampling skips.
    dropped_background, dropped_refractory
        Kept back by the camera's own filters of background activity and of the refractory period.
    dropped_rate
        Beyond the rate that the camera was told to keep.
    dropped_late
        Waited longer than the camera keeps events.
    edges
        The same for the external input.
    readings
        The same for frames and the like, by `ReadingKind`; none for a camera that has no use for them.
    """

    offered: int = 0
    not_running: int = 0
    dropped_fifo: int = 0
    flushed: int = 0
    delivered: int = 0
    lost_on_link: int = 0
    queued: int = 0
    not_selected: int = 0
    dropped_background: int = 0
    dropped_refractory: int = 0
    dropped_rate: int = 0
    dropped_late: int = 0
    edges: EdgeCounters = field(default_factory=EdgeCounters)
    readings: Mapping[str, ReadingCounters] = field(default_factory=dict)

    @property
    def dropped_for_room(self) -> int:
        """Events that were to be sent and were dropped before they were; what links tell as `dropped`."""
        return self.dropped_fifo + self.flushed + self.dropped_rate + self.dropped_late

    @property
    def dropped_in_device(self) -> int:
        """Events that the camera took and did not hand to the link."""
        filtered = self.not_selected + self.dropped_background + self.dropped_refractory
        return self.not_running + filtered + self.dropped_for_room

    @property
    def accounted(self) -> int:
        """Events with a fate: as many as were offered, or something is wrong."""
        return self.dropped_in_device + self.delivered + self.lost_on_link + self.queued


class EventDevice(ABC):
    """An event camera without its cable. One thread at a time may use it.

    Attributes
    ----------
    set_by : by what hosts set the biases of its sensor, "register" or "telecommand".
    """

    set_by: ClassVar[str] = "register"

    @property
    @abstractmethod
    def now_us(self) -> int:
        """Stream time that the camera has reached."""

    @property
    @abstractmethod
    def streaming(self) -> bool:
        """True while events offered now would go to the host."""

    @property
    @abstractmethod
    def room_events(self) -> int:
        """Events that certainly fit its buffer now."""

    @property
    def horizon_us(self) -> int:
        """Stream time to which it can be advanced now without dropping what waits, for runs that are not paced."""
        return _FOREVER_US

    @property
    def silent_until_us(self) -> int:
        """Time, as it is told to the device, until which it sends nothing, because its host is not ready before."""
        return 0

    @property
    def epoch_us(self) -> int:
        """Time, as it is told to the device, at which the device's own clock was last zero."""
        return 0

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """What its host's settings multiply figures of the sensor by, by their names; those not named stay."""
        return {}

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Settings that its host has moved and that change nothing in the simulated sensor, and why, by their names."""
        return {}

    def take_commands(self) -> tuple[str, ...]:
        """Return the telecommands that changed it since the last call, as text."""
        return ()

    @property
    @abstractmethod
    def counters(self) -> CameraCounters:
        """Fates of all events offered so far."""

    @abstractmethod
    def offer(self, events: Events) -> None:
        """Give the camera what its array raised, (n,) EVENT in stream time, sorted, not before the time advanced to.

        The events are copied. Raises ValueError when they go back in time or lie outside the array; then none is taken.
        """

    @abstractmethod
    def offer_edges(self, edges: Edges) -> None:
        """Give the camera edges on its external input, (n,) EDGE in stream time, sorted; copied.

        An edge may be older than `now_us`: it was measured elsewhere and comes as soon as it can, with its own time;
        where later events have left already, it may be dated as early as possible.
        A camera whose detector is off, or that has none, counts them as ignored.
        """

    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """What its host asks of a kind of readings, in the order of that kind's settings; empty: it wants none."""
        return ()

    def room_readings(self, kind: ReadingKind) -> int:
        """Readings of a kind that certainly fit its buffer now, for runs that are not paced."""
        return _NO_BOUND

    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Give the camera readings of one kind, (n,) in stream time, sorted; copied.

        False: it has no use for this kind, ever, and whoever offered them counts them as ignored.
        """
        return False

    @abstractmethod
    def advance(self, now_us: int) -> None:
        """Say that stream time has reached `now_us`; the clock never goes back."""

    def take_resets(self) -> tuple[int, ...]:
        """Return, in its own time, when its host has set its clock to zero since the last call: for a sync cable."""
        return ()

    def follow_reset(self, at_us: int) -> None:
        """Set its clock to zero at `at_us` of its own time, which has been reached: its master was reset then."""
        self.restart_clock()

    def restart_clock(self) -> bool:
        """Start the device's own clock anew at zero, now, as a pulse on a synchronisation input does.

        False for a device that has no such input.
        """
        return False
