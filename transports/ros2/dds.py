"""Writers and readers of topics of ROS 2 by CycloneDDS, for messages that are bytes.

CycloneDDS has threads of its own, which send, receive and acknowledge; no call here waits.

The two types of messages for CycloneDDS. Messages are bytes here, which `firmware_protocol.ros2` makes and reads.

CycloneDDS needs the members to describe the types to others; it would code each message member by member in Python.
Names are as ROS 2 gives them to DDS. This module is imported by `dds`, where CycloneDDS is installed.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

from cyclonedds.core import DDSException, Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.idl.types import int32, sequence, uint8, uint32, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

from firmware_protocol.ros2.messages import EVENT_PACKET, IMAGE, MessageType
from transports.ros2.kind import DdsNetwork

__all__ = ["MESSAGE_TYPES", "DdsParticipant", "Message", "RawMessage", "TopicQos", "TopicReader", "TopicWriter"]


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


_MOST_AT_ONCE = 16


@dataclass(frozen=True)
class TopicQos:
    """How a topic is written or read.

    Attributes
    ----------
    reliable
        Whether what is lost on the way is sent again. A reliable reader does not match a writer that is not.
    depth
        Messages that are kept: the last ones.
    """

    reliable: bool = True
    depth: int = 16


@dataclass(frozen=True)
class Message:
    """A message and the Unix time at which its writer wrote it, ns, by that machine's clock."""

    data: bytes
    written_ns: int


class DdsParticipant:
    """Membership in a domain; raises OSError, with what to do, when the network cannot be had. One for each domain."""

    def __init__(self, network: DdsNetwork) -> None:
        try:
            self._domain = Domain(network.domain, network.configuration)
            self._participant = DomainParticipant(network.domain, Qos(Policy.Userdata(b"enclave=/;")))
        except DDSException as error:
            named = ", ".join(network.interfaces) or "the loopback interface"
            raise OSError(
                f"cannot join DDS domain {network.domain} on {named} ({error.msg.strip()}): is the interface there "
                "(`ip address`), are there less than 32 processes in the domain, and no second one of this process?"
            ) from error

    def writer(self, topic: str, kind: MessageType, qos: TopicQos) -> TopicWriter:
        """Return a writer of the topic that ROS 2 calls `topic`."""
        return TopicWriter(DataWriter(self._participant, self._topic(topic, kind), qos=_qos(kind, qos)), kind)

    def reader(self, topic: str, kind: MessageType, qos: TopicQos) -> TopicReader:
        """Return a reader of the topic that ROS 2 calls `topic`."""
        return TopicReader(DataReader(self._participant, self._topic(topic, kind), qos=_qos(kind, qos)))

    def close(self) -> None:
        """Leave the domain, after its writers and readers are closed; a second call does nothing."""
        for name in ("_participant", "_domain"):  # CycloneDDS deletes what nothing refers to
            self.__dict__.pop(name, None)

    def _topic(self, topic: str, kind: MessageType) -> Any:
        return Topic(self._participant, f"rt{topic}", MESSAGE_TYPES[kind])


class TopicWriter:
    """Writes messages to one topic."""

    def __init__(self, writer: Any, kind: MessageType) -> None:
        self._writer = writer
        self._type = MESSAGE_TYPES[kind]

    @property
    def readers(self) -> int:
        """How many readers there are."""
        # DataWriter.get_matched_subscriptions of cyclonedds 11.0.1 raises IndexError where one comes meanwhile.
        return int(self._writer.get_publication_matched_status().current_count)

    @property
    def acknowledged(self) -> bool:
        """Whether all reliable readers have all that was written."""
        # DataWriter.wait_for_acks of cyclonedds 11.0.1 raises AttributeError where it should return False.
        return bool(self._writer._wait_for_acks(self._writer._ref, 0) == 0)

    def write(self, data: bytes) -> bool:
        """Write a message; False when DDS does not take it."""
        try:
            self._writer.write(self._type(data))
        except DDSException:
            return False
        return True

    def close(self) -> None:
        """Leave the topic."""
        self._writer = None


class TopicReader:
    """Reads messages of one topic."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    @property
    def writers(self) -> int:
        """How many writers there are."""
        return int(self._reader.get_subscription_matched_status().current_count)

    def take(self) -> list[Message]:
        """Return what has come, at most 16 messages."""
        taken = self._reader.take(N=_MOST_AT_ONCE)
        return [Message(one.data, one.sample_info.source_timestamp) for one in taken if one.sample_info.valid_data]

    def close(self) -> None:
        """Leave the topic."""
        self._reader = None


def _qos(kind: MessageType, qos: TopicQos) -> Qos:
    reliable = Policy.Reliability.Reliable(max_blocking_time=0)
    return Qos(
        reliable if qos.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(qos.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(kind.user_data),
    )
