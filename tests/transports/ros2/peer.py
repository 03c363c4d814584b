"""A program that reads or writes topics as a node of ROS 2 on the same machine, in a process of its own.

Its types and quality of service are written from the definitions of ROS 2, its configuration is what rmw_cyclonedds
makes of ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST and the CYCLONEDDS_URI of docs/streams.md. It
imports nothing of evstim.

    python peer.py read DOMAIN TOPIC Type ReliabilityDepth     length (u32) and CDR of each message, on stdout
    python peer.py write DOMAIN TOPIC Type ReliabilityDepth    the same, from stdin
"""

import signal
import struct
import sys
import time
from dataclasses import dataclass

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, types
from cyclonedds.idl.annotations import autoid, final
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic

CONFIGURATION = (
    "<CycloneDDS><Domain><General><AllowMulticast>false</AllowMulticast></General><Discovery><ParticipantIndex>auto"
    "</ParticipantIndex><MaxAutoParticipantIndex>32</MaxAutoParticipantIndex><Peers><Peer address=\"localhost\"/>"
    "</Peers></Discovery></Domain></CycloneDDS>,"
    "<General><Interfaces><NetworkInterface address=\"127.0.0.1\"/></Interfaces></General>"
)  # fmt: skip


def as_bytes(kind):
    """Let messages be bytes: CycloneDDS would take them apart in Python."""

    def initialise(message, data):
        message.data = data

    kind.__init__ = initialise
    kind.serialize = lambda message, *_, **__: message.data
    kind.deserialize = kind.deserialize_key = staticmethod(lambda data, *_, **__: kind(data))
    return kind


@dataclass
@final
@autoid("sequential")
class Time(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: types.int32
    nanosec: types.uint32


@dataclass
@final
@autoid("sequential")
class Header(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time
    frame_id: str


@as_bytes
@final
@autoid("sequential")
class EventPacket(IdlStruct, typename="event_camera_msgs.msg.dds_.EventPacket_"):
    header: Header
    height: types.uint32
    width: types.uint32
    seq: types.uint64
    time_base: types.uint64
    encoding: str
    is_bigendian: bool
    events: types.sequence[types.uint8]


@as_bytes
@final
@autoid("sequential")
class Image(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header
    height: types.uint32
    width: types.uint32
    encoding: str
    is_bigendian: types.uint8
    step: types.uint32
    data: types.sequence[types.uint8]


def say(text):
    sys.stderr.write(f"{text}\n")
    sys.stderr.flush()


def read(reader):
    while not reader.get_matched_publications():
        time.sleep(0.01)
    say("matched")
    told = set()
    while True:
        for message in reader.take(N=64):
            if not message.sample_info.valid_data:
                continue
            if message.sample_info.publication_handle not in told:
                told.add(message.sample_info.publication_handle)
                writer = reader.get_matched_publication_data(message.sample_info.publication_handle)
                say(f"{writer.type_name} {bytes(writer.qos[Policy.Userdata].data).decode()}")
            sys.stdout.buffer.write(struct.pack("<I", len(message.data)) + message.data)
        sys.stdout.buffer.flush()
        time.sleep(0.001)


def write(writer, kind):
    while not writer.get_matched_subscriptions():
        time.sleep(0.01)
    say("matched")
    while head := sys.stdin.buffer.read(4):
        writer.write(kind(sys.stdin.buffer.read(struct.unpack("<I", head)[0])))
    time.sleep(0.5)


def main():
    verb, domain, topic, name, reliability = sys.argv[1:]
    kind = {"EventPacket": EventPacket, "Image": Image}[name]
    domain = int(domain)
    keeps = Domain(domain, CONFIGURATION), DomainParticipant(domain)
    reliable = Policy.Reliability.Reliable(max_blocking_time=100_000_000)
    qos = Qos(
        reliable if reliability == "reliable" else Policy.Reliability.BestEffort,
        Policy.Durability.Volatile,
        Policy.History.KeepAll if reliability == "reliable" else Policy.History.KeepLast(1000),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    topic = Topic(keeps[1], f"rt{topic}", kind)
    if verb == "read":
        read(DataReader(keeps[1], topic, qos=qos))
    else:
        write(DataWriter(keeps[1], topic, qos=qos), kind)


if __name__ == "__main__":
    signal.signal(signal.SIGINT, signal.default_int_handler)  # ignored by what a shell starts in the background
    main()
