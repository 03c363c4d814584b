"""Interface of an event camera to the run that feeds it, for any link: USB, a serial line, a CAN bus.

    ring --events--> offer ---+
    bus  --edges---> offer_edges --> device --> its own way out: USB transfers, messages, frames
    run  --time----> advance -+
    ring --frames, samples--> offer_readings

A device is sans-I/O. Events and edges go in with stream time; each gets exactly one fate, which `counters` reports.

Readings are the data of a camera beside events: lines of a frame, samples of an inertial unit. Each gets a fate too. A
reading is one record of a structured array that has a field `t`, u64 microseconds of stream time. Its kind determines
the record: `frames.line_record` for frames.
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
    """Kind of a reading."""

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
        Arrived while the host had not enabled this kind, or in the middle of a frame whose start it did not get.
    dropped
        Dropped for lack of room.
    flushed
        Were in the buffer when it was emptied.
    lost_on_link
        Left the camera and were lost on the link.
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
        """Readings with a fate; without an error as many as were offered."""
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
        Not detected: the camera was not running, or its registers exclude this kind of edge.
    dropped
        Detected, and lost because a buffer was full or emptied.
    lost_on_link
        Left the camera and were lost on the link.
    added
        Made by the camera beyond one for each edge offered: a rising edge may be reported again as the pulse that it
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
        """Edges with a fate; without an error as many as were offered and added."""
        return self.ignored + self.dropped + self.delivered + self.lost_on_link + self.queued


@dataclass(frozen=True)
class CameraCounters:
    """Events offered to a camera since it was made, and their fates; `offered` is the sum of the others.

    Attributes
    ----------
    not_running
        Arrived while no host had the camera running.
    dropped_fifo
        Found the camera's buffer full, in events or in bytes.
    flushed
        Were in the buffer when it was emptied, at a stop or when the host went away.
    lost_on_link
        Left the camera and were lost on the link.
    queued
        Still wait.
    not_selected
        Excluded on purpose: outside the region of interest, or a pixel that sub-sampling skips.
    dropped_background, dropped_refractory
        Dropped by the camera's own filters of background activity and of the refractory period.
    dropped_rate
        Beyond the camera's rate limit.
    dropped_late
        Waited longer than the camera's age limit.
    edges
        Counters of the external input.
    readings
        Counters of frames and the like, by `ReadingKind`; empty for a camera that does not use them.
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
        """Events that were to be sent and were dropped before; links report them as `dropped`."""
        return self.dropped_fifo + self.flushed + self.dropped_rate + self.dropped_late

    @property
    def dropped_in_device(self) -> int:
        """Events that the camera took and did not hand to the link."""
        filtered = self.not_selected + self.dropped_background + self.dropped_refractory
        return self.not_running + filtered + self.dropped_for_room

    @property
    def accounted(self) -> int:
        """Events with a fate; without an error as many as were offered."""
        return self.dropped_in_device + self.delivered + self.lost_on_link + self.queued


class EventDevice(ABC):
    """An event camera without a transport. One thread at a time may use it.

    Attributes
    ----------
    set_by : the way in which hosts set the biases of its sensor, "register" or "telecommand".
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
    def at_rest(self) -> bool:
        """True while no host notices the time that it has reached: a request finds it advanced all the same."""
        return not self.streaming and self.now_us >= self.silent_until_us

    @property
    def settings_version(self) -> int | None:
        """Number that changes with its sensor factors, settings without effect, commands and settings of readings.

        None: these are to be compared each time.
        """
        return None

    @property
    @abstractmethod
    def room_events(self) -> int:
        """Events that certainly fit its buffer now."""

    @property
    def horizon_us(self) -> int:
        """Stream time to which it can advance now without dropping events that wait, for runs that are not paced."""
        return _FOREVER_US

    @property
    def silent_until_us(self) -> int:
        """Time, on the scale of `now_us`, until which it sends nothing, because its host is not ready before."""
        return 0

    @property
    def epoch_us(self) -> int:
        """Time, on the scale of `now_us`, at which the device's own clock was last zero."""
        return 0

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Factors of the sensor's parameters by its host's settings, by name; parameters not named are unchanged."""
        return {}

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Settings that its host changed without an effect on the simulated sensor, by name, each with the reason."""
        return {}

    def take_commands(self) -> tuple[str, ...]:
        """Return the telecommands that changed it since the last call, as text."""
        return ()

    @property
    @abstractmethod
    def counters(self) -> CameraCounters:
        """Fates of all events offered so far."""

    @property
    def delivered(self) -> int:
        """Number of events that left it, as `counters` has it; devices count it without the other fates."""
        return self.counters.delivered

    @property
    def waiting_items(self) -> int:
        """Number of events, edges and readings that wait in it, as `counters` has them."""
        counters = self.counters
        return counters.queued + counters.edges.queued + sum(one.queued for one in counters.readings.values())

    @abstractmethod
    def offer(self, events: Events) -> None:
        """Take the events of the array, (n,) EVENT in stream time, sorted, none before the time advanced to.

        The events are copied. Raises ValueError if they go back in time or lie outside the array; then none is taken.
        """

    @abstractmethod
    def offer_edges(self, edges: Edges) -> None:
        """Apply edges, (n,) EDGE in stream time, sorted, to the external input; they are copied.

        An edge may be older than `now_us`: it was measured elsewhere and arrives as soon as it can, with its own time.
        If later events have left already, it may get the earliest possible time instead.
        A camera whose detector is off, or that has none, counts them as ignored.
        """

    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Settings of its host for a kind of readings, in the order of that kind's settings; empty: none requested."""
        return ()

    def room_readings(self, kind: ReadingKind) -> int:
        """Readings of a kind that certainly fit its buffer now, for runs that are not paced."""
        return _NO_BOUND

    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Take readings of one kind, (n,) in stream time, sorted; they are copied.

        False: it never uses this kind, and the caller counts them as ignored.
        """
        return False

    @abstractmethod
    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`; the clock never goes back."""

    def take_resets(self) -> tuple[int, ...]:
        """Return the times, on its own scale, at which its host set its clock to zero since the last call."""
        return ()

    def follow_reset(self, at_us: int) -> None:
        """Set its clock to zero at `at_us` of its own time, which is in the past: its master was reset then."""
        self.restart_clock()

    def restart_clock(self) -> bool:
        """Restart the device's own clock at zero, now, as a pulse on a synchronisation input does.

        False for a device that has no such input.
        """
        return False
