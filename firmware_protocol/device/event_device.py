"""Interface of an event camera to the run that feeds it, for any link: USB, a serial line, a CAN bus.

    ring --events--> offer ---+
    bus  --edges---> offer_edges --> device --> its own way out: USB transfers, messages, frames
    run  --time----> advance -+
    ring --frames, samples--> offer_readings

A device is sans-I/O. Events, edges and readings (lines of a frame, samples of an inertial unit) go in with clock time,
which the methods of devices call stream time: the two differ only where a rig gives the camera a clock of its own;
each of these items gets exactly one fate, which `counters` reports.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import ClassVar, TypeVar

from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import ItemEncoder, Items, Numbers, ReadingKind, Readings
from firmware_protocol.events import Edges, Events

_FOREVER_US = 1 << 62
_NO_BOUND = 1 << 30

_Taken = TypeVar("_Taken", bound=Items)


class EventDevice(ABC):
    """An event camera without a transport. One thread at a time may use it.

    What only some devices have stands in classes of its own, from which they inherit beside this one: `HostAdjusted`,
    `TakesReadings`, `HasClockInput`, `StartsSilent`.
    """

    _fates: Fates
    _now_us = 0

    @property
    def now_us(self) -> int:
        """Stream time that the camera has reached."""
        return self._now_us

    @property
    @abstractmethod
    def streaming(self) -> bool:
        """True while events offered now would go to the host."""

    @property
    def at_rest(self) -> bool:
        """True while no host notices the time that it has reached: a request finds it advanced all the same."""
        return not self.streaming

    @property
    @abstractmethod
    def room_events(self) -> int:
        """Events that certainly fit its buffer now."""

    @property
    def horizon_us(self) -> int:
        """Stream time to which it can advance now without dropping events that wait, for runs that are not paced."""
        return _FOREVER_US

    @property
    def epoch_us(self) -> int:
        """Time, on the scale of `now_us`, at which the device's own clock was last zero."""
        return 0

    @property
    @abstractmethod
    def _waiting(self) -> Numbers:
        """Numbers of items that wait in it, beside those that `_fates` counts as queued."""

    @property
    def counters(self) -> Fates:
        """Fates of all items so far."""
        return self._fates.waiting(self._waiting)

    @property
    def delivered(self) -> int:
        """Number of events that left it, as `counters` has it, without a count of the other fates."""
        return self._fates.delivered

    @property
    def waiting_items(self) -> int:
        """Number of events, edges and readings that wait in it, as `counters` has them."""
        return self._fates.all_queued + self._waiting.total

    def sent(self, items: Items) -> None:
        """Count items that were taken as delivered."""
        self._fates.leave(items, "delivered")

    def lost(self, items: Items) -> None:
        """Count items that were taken as lost on the link."""
        self._fates.leave(items, "lost_on_link")

    def _taken(self, items: _Taken | None) -> _Taken | None:
        """Count items that have left their encoder, and return them; `sent` or `lost` must follow for them."""
        if items is not None:
            self._fates.take(items)
        return items

    def _flush(self, encoder: ItemEncoder[Items]) -> None:
        """Drop and count what waits in an encoder."""
        self._fates.drop(encoder.waiting)
        encoder.clear()

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

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`; the clock never goes back."""
        self._now_us = max(self._now_us, now_us)


class HostAdjusted(ABC):
    """A device whose hosts change the parameters of its sensor, by registers or telecommands.

    `set_by`: the way in which hosts set the biases of its sensor, "register" or "telecommand".
    """

    set_by: ClassVar[str] = "register"
    settings_version = 0
    """Number that changes with its factors, settings without effect, commands and settings of readings."""

    @property
    @abstractmethod
    def sensor_factors(self) -> Mapping[str, float]:
        """Factors of the sensor's parameters by its host's settings, by name, or Hz to add to `highpass_hz`."""

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Settings that its host changed without an effect on the simulated sensor, by name, each with the reason."""
        return {}

    def take_commands(self) -> tuple[str, ...]:
        """Return the telecommands that changed it since the last call, as text."""
        return ()


class TakesReadings(ABC):
    """A device that takes readings: lines of frames, samples of an inertial unit."""

    settings_version: int
    """Number that changes with the settings of readings."""

    @abstractmethod
    def reading_settings(self, kind: ReadingKind) -> tuple[int, ...]:
        """Settings of its host for a kind of readings, in the order of that kind's settings; empty: none requested."""

    def room_readings(self, kind: ReadingKind) -> int:
        """Readings of a kind that certainly fit its buffer now, for runs that are not paced."""
        return _NO_BOUND

    @abstractmethod
    def offer_readings(self, kind: ReadingKind, readings: Readings) -> bool:
        """Copy readings of a kind, (n,) in stream time, sorted. False: never used; the caller counts them ignored."""


class HasClockInput(ABC):
    """A device with a synchronisation input, which sets its clock to zero."""

    @abstractmethod
    def restart_clock(self) -> bool:
        """Restart its clock at zero, now, as a pulse on the input does; False if this model has no such input."""

    def take_resets(self) -> tuple[int, ...]:
        """Return the times, on its own scale, at which its host set its clock to zero since the last call."""
        return ()

    def follow_reset(self, at_us: int) -> None:
        """Set its clock to zero at `at_us` of its own time, which is in the past: its master was reset then."""
        self.restart_clock()


class StartsSilent(EventDevice):
    """A device that sends nothing for a while after its start, because its host is not ready before."""

    @property
    @abstractmethod
    def silent_until_us(self) -> int:
        """End of the silence, on the scale of `now_us`; a past time if there is none."""

    @property
    def at_rest(self) -> bool:
        """True while it neither streams nor waits for the end of its silence."""
        return not self.streaming and self.now_us >= self.silent_until_us
