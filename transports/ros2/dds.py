"""Writers and readers of topics of ROS 2 by CycloneDDS, for messages that are bytes.

CycloneDDS has its own threads, which send, receive and acknowledge; no call here waits.

The types of messages here contain bytes, which `firmware_protocol.ros2` encodes and decodes. CycloneDDS needs the
members only to describe the types to other participants; it would encode each message member by member in Python. Names
are those that ROS 2 gives to DDS.
"""

# No `from __future__ import annotations`: CycloneDDS reads the annotations of the messages, and cannot resolve `str`.

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

from firmware_protocol.ros2 import EVENT_PACKET, IMAGE, MessageType
from transports.ros2.kind import DdsNetwork


class RawMessage(Protocol):
    """Message in encoded form."""

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
    """Quality of service of a topic.

    Attributes
    ----------
    reliable : True to send lost messages again. A reliable reader does not match a writer that is not reliable.
    depth : number of stored messages, the newest ones.
    """

    reliable: bool = True
    depth: int = 16


@dataclass(frozen=True)
class Message:
    """Message with the Unix time at which its writer wrote it, ns, by the writer's clock."""

    data: bytes
    written_ns: int


class TopicWriter:
    """Writer of messages to one topic."""

    def __init__(self, writer: Any, kind: MessageType) -> None:
        self._writer = writer
        self._type = MESSAGE_TYPES[kind]

    @property
    def readers(self) -> int:
        """Number of readers."""
        # DataWriter.get_matched_subscriptions of cyclonedds 11.0.1 raises IndexError if one joins during the call.
        return int(self._writer.get_publication_matched_status().current_count)

    @property
    def acknowledged(self) -> bool:
        """True if all reliable readers have all written messages."""
        # DataWriter.wait_for_acks of cyclonedds 11.0.1 raises AttributeError where it should return False.
        return bool(self._writer._wait_for_acks(self._writer._ref, 0) == 0)

    def write(self, data: bytes) -> bool:
        """Write a message; return False when DDS refuses it."""
        try:
            self._writer.write(self._type(data))
        except DDSException:
            return False
        return True

    def close(self) -> None:
        """Leave the topic."""
        self._writer = None


class TopicReader:
    """Reader of messages of one topic."""

    def __init__(self, reader: Any) -> None:
        self._reader = reader

    @property
    def writers(self) -> int:
        """Number of writers."""
        return int(self._reader.get_subscription_matched_status().current_count)

    def take(self) -> list[Message]:
        """Return the received messages, at most 16."""
        taken = self._reader.take(N=_MOST_AT_ONCE)
        return [
            Message(sample.data, sample.sample_info.source_timestamp)
            for sample in taken
            if sample.sample_info.valid_data
        ]

    def close(self) -> None:
        """Leave the topic."""
        self._reader = None


class DdsParticipant:
    """Participant in a domain, one for each domain; raises OSError, with the remedy, if the network cannot be used."""

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
        """Return a writer of the topic named `topic` in ROS 2."""
        return TopicWriter(DataWriter(self._participant, self._topic(topic, kind), qos=_qos(kind, qos)), kind)

    def reader(self, topic: str, kind: MessageType, qos: TopicQos) -> TopicReader:
        """Return a reader of the topic named `topic` in ROS 2."""
        return TopicReader(DataReader(self._participant, self._topic(topic, kind), qos=_qos(kind, qos)))

    def close(self) -> None:
        """Leave the domain, after its writers and readers are closed; a second call does nothing."""
        for name in ("_participant", "_domain"):  # CycloneDDS deletes objects without references
            self.__dict__.pop(name, None)

    def _topic(self, topic: str, kind: MessageType) -> Any:
        return Topic(self._participant, f"rt{topic}", MESSAGE_TYPES[kind])


def _qos(kind: MessageType, qos: TopicQos) -> Qos:
    reliable = Policy.Reliability.Reliable(max_blocking_time=0)
    return Qos(
        reliable if qos.reliable else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepLast(qos.depth),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        Policy.Userdata(f"typehash=RIHS01_{kind.rihs01};".encode("ascii")),
    )
