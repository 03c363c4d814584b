"""The two types of messages for CycloneDDS. Messages are bytes here, which `firmware_protocol.ros2` makes and reads.

CycloneDDS needs the members to describe the types to others; it would code each message member by member in Python.
Names are as ROS 2 gives them to DDS. This module is imported by `dds`, where CycloneDDS is installed.
"""

# No `from __future__ import annotations`: CycloneDDS reads the annotations.

from dataclasses import dataclass
from typing import Any, Protocol

from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import int32, sequence, uint8, uint32, uint64

from firmware_protocol.ros2.messages import EVENT_PACKET, IMAGE, MessageType

__all__ = ["MESSAGE_TYPES", "RawMessage"]


class RawMessage(Protocol):
    """A message that is bytes already."""

    data: bytes

    def __init__(self, data: bytes) -> None: ...


def _raw(kind: type[Any]) -> type[RawMessage]:
    """Return a type of messages, changed so that its messages are bytes."""

    def initialise(message: Any, data: bytes) -> None:
        message.data = data

    def deserialize(data: bytes, *_: Any, **__: Any) -> Any:
        return kind(data)

    kind.__init__ = initialise
    kind.serialize = lambda message, *_, **__: message.data
    kind.deserialize = kind.deserialize_key = staticmethod(deserialize)
    return kind


@dataclass
@final
@autoid("sequential")
class _Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
@autoid("sequential")
class _Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: _Time
    frame_id: str


@final
@autoid("sequential")
class _EventPacket(IdlStruct, typename="event_camera_msgs.msg.dds_.EventPacket_"):
    header: _Header
    height: uint32
    width: uint32
    seq: uint64
    time_base: uint64
    encoding: str
    is_bigendian: bool
    events: sequence[uint8]  # type: ignore[type-arg]


@final
@autoid("sequential")
class _Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: _Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]  # type: ignore[type-arg]


MESSAGE_TYPES: dict[MessageType, type[RawMessage]] = {EVENT_PACKET: _raw(_EventPacket), IMAGE: _raw(_Image)}
