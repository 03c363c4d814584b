"""Changes that hosts and users make at a camera while a run goes on, each with its stream time: data for the session.

    host --bias, telecommand--> device --> ChangeWatch --CameraSettings, Occurrence--> session
    user --fault, edge by hand-----------> ChangeWatch -----------------Occurrence---> session

The stream time of a change is that which the camera had reached when it took the change: all events up to there had
gone through it, and none after. How far the camera is, it stores after its changes have been sent (`EventRing.settle`).
So a session that waits for a camera has all changes before a stream time when the camera has reached that time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field

from firmware_protocol.event_device import EventDevice

__all__ = ["CameraSettings", "ChangeWatch", "Occurrence"]

_MOST_WAITING = 1000  # changes that a session too busy to read has not taken
_FOREVER_US = 1 << 62


@dataclass(frozen=True)
class CameraSettings:
    """The settings of a camera that act on its sensor, from a stream time on.

    Attributes
    ----------
    t_us
        Stream time that the camera had reached.
    by
        "register", "telecommand"; or "restart", where the camera has its power-on settings again.
    sensor_factors, without_effect
        See `EventDevice`.
    """

    t_us: int
    by: str
    sensor_factors: Mapping[str, float] = field(default_factory=dict)
    without_effect: Mapping[str, str] = field(default_factory=dict)


@dataclass(frozen=True)
class Occurrence:
    """Something else that was done to a camera from outside: a telecommand, a fault, an edge by hand.

    Attributes
    ----------
    t_us
        Stream time that the camera had reached.
    by
        Its origin: "telecommand", or the user's name for the session's request, such as "evstim".
    what
        Such as "SetRegion(x=0, y=0, width=8, height=8)", "fault stall", "trigger pulse".
    """

    t_us: int
    by: str
    what: str


class ChangeWatch:
    """Notices the changes of one device, and holds them until the session takes them.

    Attributes
    ----------
    waiting
        Changes that have not been sent, the oldest first.
    """

    def __init__(self, device: EventDevice) -> None:
        self._device = device
        self._acts = type(device).sensor_factors is not EventDevice.sensor_factors
        self._factors: dict[str, float] = {}
        self._without_effect: dict[str, str] = {}
        self._not_listed = 0
        self.waiting: deque[CameraSettings | Occurrence] = deque()

    def look(self, t_us: int) -> None:
        """Take down what has changed since the last call, while the camera stood at stream time `t_us`."""
        by = self._device.set_by
        for command in self._device.take_commands():
            self.add(Occurrence(t_us, by, command))
        factors, without_effect = dict(self._device.sensor_factors), dict(self._device.without_effect)
        if (factors, without_effect) != (self._factors, self._without_effect):
            self._factors, self._without_effect = factors, without_effect
            self.add(CameraSettings(t_us, by, factors, without_effect))

    def add(self, change: CameraSettings | Occurrence) -> None:
        """Take down a change; where 1000 wait, occurrences are counted only, and settings replace the last ones.

        So the sensor follows the settings whatever else a host sends.
        """
        if len(self.waiting) < _MOST_WAITING:
            self._add_count(change.t_us)
            self.waiting.append(change)
        elif isinstance(change, Occurrence):
            self._not_listed += 1
        else:
            self._replace_settings(change)

    def _add_count(self, t_us: int) -> None:
        if self._not_listed:
            self.waiting.append(Occurrence(t_us, self._device.set_by, f"{self._not_listed} more, not listed"))
            self._not_listed = 0

    def _replace_settings(self, settings: CameraSettings) -> None:
        if isinstance(self.waiting[-1], CameraSettings):
            self.waiting.pop()
        self.waiting.append(settings)

    def settled_us(self, reached_us: int) -> int:
        """Return the stream time before which no change of the sensor is to come, of a camera that is at `reached_us`.

        Without limit where nothing that hosts do at it can act on the sensor.
        """
        return reached_us if self._acts else _FOREVER_US
