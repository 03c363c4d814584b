"""One SIM_UPDATE of Basilisk: the time, and where spacecraft, celestial bodies and cameras are.

Positions are in Basilisk's inertial frame N, metres; attitudes as they are on the wire. Values are checked when they
are asked for, so what nobody looks at may be anything.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

from firmware_protocol.vizard.messages import message_class

__all__ = ["CameraState", "State", "Update", "UpdateError"]

_LATEST_NS = 1 << 53  # a double counts single nanoseconds up to here, 104 days
_SHOWN_NAMES = 8
_SHOWN_LETTERS = 40


class UpdateError(ValueError):
    """An update cannot be used; the text says what of it and why."""


@dataclass(frozen=True)
class State:
    """Place and attitude of a spacecraft or a celestial body.

    Attributes
    ----------
    position_m : three numbers, in N.
    rotation
        Spacecraft: three Modified Rodrigues Parameters sigma_BN. Celestial body: nine numbers, row by row, the matrix
        that turns coordinates of N into those of the body.
    """

    position_m: tuple[float, ...]
    rotation: tuple[float, ...]


@dataclass(frozen=True)
class CameraState:
    """A camera as Basilisk describes it.

    Attributes
    ----------
    parent : name of its spacecraft.
    position_m : three numbers, in the spacecraft's frame.
    direction : three Modified Rodrigues Parameters, the attitude with a third of a turn for Unity's axes added.
    field_of_view_deg : along the picture's height.
    size : (width, height), pixels.
    """

    parent: str
    position_m: tuple[float, ...]
    direction: tuple[float, ...]
    field_of_view_deg: float
    size: tuple[int, int]


class Update:
    """The state of a simulation at one instant.

    Attributes
    ----------
    time_ns : simulated time.
    frame : Basilisk's own count.

    Raises
    ------
    UpdateError
        The bytes are no VizMessage, or have no time.
    """

    def __init__(self, data: bytes) -> None:
        self._message = _parsed(data)
        time_ns = float(self._message.currentTime.simTimeElapsed)
        if not 0 <= time_ns <= _LATEST_NS:  # NaN compares false
            raise UpdateError(f"the update's time is {time_ns:g} ns: 0 to 2^53 can be used, 104 days")
        self.time_ns = round(time_ns)
        self.frame = int(self._message.currentTime.frameNumber)

    @property
    def camera_ids(self) -> tuple[int, ...]:
        """Numbers of its cameras."""
        return tuple(int(one.cameraID) for one in self._message.cameras)

    def spacecraft(self, name: str) -> State:
        """Return a spacecraft by its name; the first one for an empty name. Raises UpdateError."""
        there = self._message.spacecraft
        found = there[0] if there and not name else _named(there, "spacecraftName", name, "spacecraft")
        return _state(found, 3, f"spacecraft {_shown(found.spacecraftName)}")

    def body(self, name: str) -> State:
        """Return a celestial body by its name; raises UpdateError."""
        found = _named(self._message.celestialBodies, "bodyName", name, "celestial body")
        return _state(found, 9, f"celestial body {_shown(name)}")

    def camera(self, number: int) -> CameraState:
        """Return a camera by its cameraID; raises UpdateError."""
        found = next((one for one in self._message.cameras if one.cameraID == number), None)
        if found is None:
            raise UpdateError(f"there is no camera {number} in the update; there are: {_list(self.camera_ids)}")
        what = f"camera {number}"
        if len(found.resolution) != 2:
            raise UpdateError(f"{what}: resolution has {len(found.resolution)} numbers, 2 are needed")
        return CameraState(
            found.parentName,
            _numbers(found.cameraPos_B, 3, f"{what}: cameraPos_B"),
            _numbers(found.cameraDir_B, 3, f"{what}: cameraDir_B"),
            float(found.fieldOfView),
            (int(found.resolution[0]), int(found.resolution[1])),
        )


def _parsed(data: bytes) -> Any:
    from google.protobuf.message import DecodeError

    message = message_class("VizMessage")()
    try:
        message.ParseFromString(data)
    except DecodeError as error:
        raise UpdateError(f"{len(data)} bytes are no VizMessage") from error
    if not message.HasField("currentTime"):
        raise UpdateError("the VizMessage has no currentTime")
    return message


def _named(there: Iterable[Any], field: str, name: str, what: str) -> Any:
    found = next((one for one in there if getattr(one, field) == name), None)
    if found is None:
        names = _list([_shown(getattr(one, field)) for one in there])
        raise UpdateError(f"there is no {what} {_shown(name)} in the update; there are: {names}")
    return found


def _state(found: Any, turns: int, what: str) -> State:
    position_m = _numbers(found.position, 3, f"{what}: position")
    return State(position_m, _numbers(found.rotation, turns, f"{what}: rotation"))


def _numbers(values: Sequence[float], count: int, what: str) -> tuple[float, ...]:
    if len(values) != count:
        raise UpdateError(f"{what} has {len(values)} numbers, {count} are needed")
    if not all(map(math.isfinite, values)):
        raise UpdateError(f"{what} is {list(values)}: all must be finite")
    return tuple(values)


def _shown(name: str) -> str:
    """Return a name for a message: a peer may send any length of anything."""
    return repr(name if len(name) <= _SHOWN_LETTERS else f"{name[:_SHOWN_LETTERS]}...")


def _list(names: Sequence[object]) -> str:
    more = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return ", ".join(map(str, names[:_SHOWN_NAMES])) + more if names else "none"
