"""Messages of Basilisk's vizInterface: the part of VizMessage that evstim reads, and requests with their replies.

Field numbers and types: `vizMessage.proto` in the repository AVSLab/basilisk (develop of July 2026), compared with the
messages that bsk 2.12.1 sends. Fields that are not named here are skipped. The description is made at run time, in a
pool of its own: so no generated code has to fit the installed library, and there is no conflict with the messages of
other packages.

`Update` is one SIM_UPDATE of Basilisk: the time, and the states of spacecraft, celestial bodies and cameras. Positions
are in Basilisk's inertial frame N, metres; attitudes as they are on the wire. Values are checked when they are read, so
unused ones may be anything.

Each request, and each reply, is a list of parts of one ZeroMQ message:

    request                                        reply
    PING                                           PONG
    SIM_UPDATE, "", "", VizMessage                 OK; Basilisk raises an error at anything else
    REQUEST_INPUT             (live stream only)   VIZARD_INPUT, VizInput (here empty: no input of a user)
    REQUEST_IMAGE_<cameraID>                       length as big-endian int32, that many bytes of an image file

Basilisk waits from each request to its reply. Source: `vizInterface.cpp` in AVSLab/basilisk (develop of July 2026), and
the messages that bsk 2.12.1 sends.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

_PACKAGE = "vizProtobufferMessage"

_STATE = {"position": (2, "double*"), "velocity": (3, "double*"), "rotation": (4, "double*")}
_FIELDS: Mapping[str, Mapping[str, tuple[int, str]]] = {
    "TimeStamp": {"frameNumber": (1, "int64"), "simTimeElapsed": (2, "double")},
    "CelestialBody": {"bodyName": (1, "string"), **_STATE},
    "Spacecraft": {"spacecraftName": (1, "string"), **_STATE},
    "CameraConfig": {
        "cameraID": (1, "int64"),
        "parentName": (2, "string"),
        "fieldOfView": (3, "double"),
        "resolution": (4, "int32*"),
        "cameraPos_B": (7, "double*"),
        "cameraDir_B": (8, "double*"),
        "renderRate": (9, "int64"),
    },
    "VizMessage": {
        "currentTime": (1, "TimeStamp"),
        "celestialBodies": (2, "CelestialBody*"),
        "spacecraft": (3, "Spacecraft*"),
        "cameras": (4, "CameraConfig*"),
    },
}
"""Message -> field -> number and type; `*`: repeated."""


@cache
def message_class(name: str) -> Any:
    """Return the class of a message; raises ImportError if protobuf is not installed."""
    from google.protobuf import message_factory

    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{_PACKAGE}.{name}"))


@cache
def _pool() -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool

    description = descriptor_pb2.FieldDescriptorProto
    file = descriptor_pb2.FileDescriptorProto(name="vizMessage.proto", package=_PACKAGE, syntax="proto3")
    for message, fields in _FIELDS.items():
        described = file.message_type.add(name=message)
        for field, (number, kind) in fields.items():
            of = kind.removesuffix("*")
            added = described.field.add(name=field, number=number)
            added.label = description.LABEL_REPEATED if kind.endswith("*") else description.LABEL_OPTIONAL
            added.type = getattr(description, "TYPE_MESSAGE" if of in _FIELDS else f"TYPE_{of.upper()}")
            if of in _FIELDS:
                added.type_name = f".{_PACKAGE}.{of}"
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool


_LATEST_NS = 1 << 53  # a double counts single nanoseconds up to here, 104 days
_SHOWN_NAMES = 8
_SHOWN_LETTERS = 40


class UpdateError(ValueError):
    """An update cannot be used; the text gives the field and the reason."""


@dataclass(frozen=True)
class State:
    """Position and attitude of a spacecraft or a celestial body.

    Attributes
    ----------
    position_m : three numbers, in N.
    rotation : Spacecraft: three Modified Rodrigues Parameters sigma_BN. Celestial body: nine numbers, row by row, the
        matrix that transforms coordinates of N into those of the body.
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
    field_of_view_deg : along the image's height.
    size : (width, height), pixels.
    """

    parent: str
    position_m: tuple[float, ...]
    direction: tuple[float, ...]
    field_of_view_deg: float
    size: tuple[int, int]


class Update:
    """The state of a simulation at one instant; raises UpdateError for bytes that are no VizMessage or have no time.

    `time_ns`: simulated time; `frame`: Basilisk's own count.
    """

    def __init__(self, data: bytes) -> None:
        self._message = _parsed(data)
        time_ns = float(self._message.currentTime.simTimeElapsed)
        if not 0 <= time_ns <= _LATEST_NS:  # NaN compares false
            raise UpdateError(f"the update's time is {time_ns:g} ns: 0 to 2^53 can be used, 104 days")
        self.time_ns = round(time_ns)
        self.frame = int(self._message.currentTime.frameNumber)

    def spacecraft(self, name: str) -> State:
        """Return a spacecraft by its name; the first one for an empty name. Raises UpdateError."""
        all_spacecraft = self._message.spacecraft
        if all_spacecraft and not name:
            spacecraft = all_spacecraft[0]
        else:
            spacecraft = _named(all_spacecraft, "spacecraftName", name, "spacecraft")
        return _state(spacecraft, 3, f"spacecraft {_shown(spacecraft.spacecraftName)}")

    def body(self, name: str) -> State:
        """Return a celestial body by its name; raises UpdateError."""
        body = _named(self._message.celestialBodies, "bodyName", name, "celestial body")
        return _state(body, 9, f"celestial body {_shown(name)}")

    def camera(self, number: int) -> CameraState:
        """Return a camera by its cameraID; raises UpdateError."""
        camera = next((candidate for candidate in self._message.cameras if candidate.cameraID == number), None)
        if camera is None:
            numbers = [int(candidate.cameraID) for candidate in self._message.cameras]
            raise UpdateError(f"there is no camera {number} in the update; there are: {_list(numbers)}")
        label = f"camera {number}"
        if len(camera.resolution) != 2:
            raise UpdateError(f"{label}: resolution has {len(camera.resolution)} numbers, 2 are needed")
        return CameraState(
            camera.parentName,
            _numbers(camera.cameraPos_B, 3, f"{label}: cameraPos_B"),
            _numbers(camera.cameraDir_B, 3, f"{label}: cameraDir_B"),
            float(camera.fieldOfView),
            (int(camera.resolution[0]), int(camera.resolution[1])),
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


def _named(candidates: Iterable[Any], field: str, name: str, noun: str) -> Any:
    match = next((candidate for candidate in candidates if getattr(candidate, field) == name), None)
    if match is None:
        names = _list([_shown(getattr(candidate, field)) for candidate in candidates])
        raise UpdateError(f"there is no {noun} {_shown(name)} in the update; there are: {names}")
    return match


def _state(message: Any, turns: int, label: str) -> State:
    position_m = _numbers(message.position, 3, f"{label}: position")
    return State(position_m, _numbers(message.rotation, turns, f"{label}: rotation"))


def _numbers(values: Sequence[float], count: int, label: str) -> tuple[float, ...]:
    if len(values) != count:
        raise UpdateError(f"{label} has {len(values)} numbers, {count} are needed")
    if not all(map(math.isfinite, values)):
        raise UpdateError(f"{label} is {list(values)}: all must be finite")
    return tuple(values)


def _shown(name: str) -> str:
    """Return a name for a message, shortened: a peer may send any text of any length."""
    return repr(name if len(name) <= _SHOWN_LETTERS else f"{name[:_SHOWN_LETTERS]}...")


def _list(names: Sequence[object]) -> str:
    hidden = f" and {len(names) - _SHOWN_NAMES} more" if len(names) > _SHOWN_NAMES else ""
    return ", ".join(map(str, names[:_SHOWN_NAMES])) + hidden if names else "none"


Parts = list[bytes]

PONG: Parts = [b"PONG"]
OK: Parts = [b"OK"]
INPUT_REPLY: Parts = [b"VIZARD_INPUT", b""]
NO_IMAGE: Parts = [bytes(4), b""]
"""Basilisk's image message is then not valid."""

_IMAGE = re.compile(rb"REQUEST_IMAGE_(\d{1,18})")
_MOST_IMAGE_BYTES = (1 << 31) - 1
_SHOWN_BYTES = 40


class RequestError(ValueError):
    """The parts are no request; the message gives the reason."""


@dataclass(frozen=True)
class Ping:
    """Request for a sign of life."""


@dataclass(frozen=True)
class SimUpdate:
    """The state of the simulation: a serialized VizMessage, not yet parsed."""

    data: bytes


@dataclass(frozen=True)
class InputRequest:
    """Request for the input of a user."""


@dataclass(frozen=True)
class ImageRequest:
    """Request for the image of a camera, at the time of the last update."""

    camera: int


Request = Ping | SimUpdate | InputRequest | ImageRequest


def parse_request(parts: Sequence[bytes]) -> Request:
    """Return the request in the parts of a message; raises RequestError."""
    match list(parts):
        case [b"PING"]:
            return Ping()
        case [b"SIM_UPDATE", _, _, data]:
            return SimUpdate(data)
        case [b"SIM_UPDATE", *more_parts]:
            raise RequestError(f"a SIM_UPDATE has 4 parts, got {1 + len(more_parts)}")
        case [b"REQUEST_INPUT"]:
            return InputRequest()
        case [first] if image := _IMAGE.fullmatch(first):
            return ImageRequest(int(image[1]))
        case [first, *more_parts]:
            raise RequestError(f"{first[:_SHOWN_BYTES]!r} with {len(more_parts)} more parts is no request")
        case _:
            raise RequestError("a message without parts is no request")


def image_reply(image: bytes) -> Parts:
    """Return the reply that carries an image file; raises ValueError if it is too long."""
    if len(image) > _MOST_IMAGE_BYTES:
        raise ValueError(f"an image of {len(image)} bytes: the length has 31 bits")
    return [len(image).to_bytes(4, "big"), image]


def merged(ours: Parts, theirs: Parts) -> Parts:
    """Return the reply to a request that two visualisers have answered.

    The other one's, if evstim has no image and no user input to give, or if the other refuses a request that evstim
    accepts; else evstim's.
    """
    return theirs if ours in (OK, NO_IMAGE, INPUT_REPLY) else ours


def refusal(reason: str) -> Parts:
    """Return the reply to a request that cannot be used; Basilisk raises an error if it was a SIM_UPDATE."""
    return [f"ERROR: {reason}".encode()]
