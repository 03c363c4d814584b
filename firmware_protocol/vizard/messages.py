"""The part of Basilisk's VizMessage that evstim reads, as classes of the protobuf library.

Field numbers and types: `vizMessage.proto` in the repository AVSLab/basilisk (develop of July 2026), compared with the
messages that bsk 2.12.1 sends. Fields that are not named here are skipped. The description is made at run time, in a
pool of its own: no generated code has to fit the installed library, and no other package's messages are in the way.
"""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any

__all__ = ["message_class"]

_PACKAGE = "vizProtobufferMessage"

_FIELDS: Mapping[str, Mapping[str, tuple[int, str]]] = {
    "TimeStamp": {"frameNumber": (1, "int64"), "simTimeElapsed": (2, "double")},
    "CelestialBody": {
        "bodyName": (1, "string"),
        "position": (2, "double*"),
        "velocity": (3, "double*"),
        "rotation": (4, "double*"),
    },
    "Spacecraft": {
        "spacecraftName": (1, "string"),
        "position": (2, "double*"),
        "velocity": (3, "double*"),
        "rotation": (4, "double*"),
    },
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
    """Return the class of a message; raises ImportError where protobuf is not installed."""
    from google.protobuf import message_factory

    return message_factory.GetMessageClass(_pool().FindMessageTypeByName(f"{_PACKAGE}.{name}"))


@cache
def _pool() -> Any:
    from google.protobuf import descriptor_pb2, descriptor_pool

    file = descriptor_pb2.FileDescriptorProto(name="vizMessage.proto", package=_PACKAGE, syntax="proto3")
    for message, fields in _FIELDS.items():
        described = file.message_type.add(name=message)
        for field, (number, kind) in fields.items():
            described.field.add(name=field, number=number, **_type(kind, descriptor_pb2.FieldDescriptorProto))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return pool


def _type(kind: str, description: Any) -> dict[str, Any]:
    """Return a field's label and type, as its description holds them."""
    of = kind.removesuffix("*")
    label = description.LABEL_REPEATED if kind.endswith("*") else description.LABEL_OPTIONAL
    if of in _FIELDS:
        return {"label": label, "type": description.TYPE_MESSAGE, "type_name": f".{_PACKAGE}.{of}"}
    return {"label": label, "type": getattr(description, f"TYPE_{of.upper()}")}
