"""Parameters of topics of ROS 2, their DDS network, and their registration as a kind of link.

The network is the domain, the network interfaces, and the machines that are contacted. Without interfaces only the
loopback interface is used, and only this machine is contacted, by unicast. ROS 2 does the same with
ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.

Sources: cyclonedds.io, "Configuration guide"; ros2/rmw_cyclonedds, rmw_node.cpp.
"""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal
from xml.sax.saxutils import quoteattr

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.evt.words import LIMIT_PX
from firmware_protocol.network_streams.coders import PictureSettings
from transports.link.kind import CameraFacts, LinkKind, LinkParameters, Unsuitable
from transports.needs import Need, package
from transports.network import is_loopback

_LOOPBACK = "127.0.0.1"
_Domain = Annotated[int, Meta(ge=0, le=232)]  # beyond it DDS has no ports left
_MOST_PROCESSES = 32  # on this machine, in one domain: as in rmw_cyclonedds
_MOST_MESSAGE = "64 MiB"
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True)
class DdsNetwork:
    """Network of the topics; raises ValueError for invalid settings.

    Attributes
    ----------
    domain : ROS_DOMAIN_ID.
    interfaces : names or addresses of network interfaces; empty: the loopback interface.
    peers : machines that are contacted by unicast, beside this one.
    multicast : True if machines on the interfaces find each other by multicast, as ROS 2 does by default.
    """

    domain: _Domain = 0
    interfaces: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    multicast: bool = False

    def __post_init__(self) -> None:
        check_bounds(self)
        elsewhere = [peer for peer in self.peers if not is_loopback(peer)]
        if not self.interfaces and (elsewhere or self.multicast):
            conflict = f"peers name {elsewhere[0]}" if elsewhere else "multicast is true"
            raise ValueError(
                f'interfaces is empty, which keeps all on this machine, but {conflict}: name the network interface, '
                'for example interfaces = ["eth0"]'
            )  # fmt: skip

    @property
    def configuration(self) -> str:
        """Configuration of CycloneDDS: large datagrams on the loopback interface, limits for foreign data."""
        names = self.interfaces or (_LOOPBACK,)
        keys = ["address" if name[:1].isdigit() or ":" in name else "name" for name in names]
        interfaces = "".join(
            f"<NetworkInterface {key}={quoteattr(name)}/>" for key, name in zip(keys, names, strict=True)
        )
        peers = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in (_LOOPBACK, *self.peers))
        sizes = "" if self.interfaces else "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>60000B</FragmentSize>"
        return (
            f"<CycloneDDS><Domain><General><Interfaces>{interfaces}</Interfaces>"
            f"<AllowMulticast>{'true' if self.multicast else 'false'}</AllowMulticast>{sizes}</General>"
            f"<Discovery><ParticipantIndex>auto</ParticipantIndex>"
            f"<MaxAutoParticipantIndex>{_MOST_PROCESSES}</MaxAutoParticipantIndex><Peers>{peers}</Peers></Discovery>"
            # A writer never waits: its unacknowledged messages are limited by the depth of its history.
            "<Internal><Watermarks><WhcHigh>1 GiB</WhcHigh></Watermarks>"
            '<HeartbeatInterval min="2 ms" minsched="4 ms" max="1 s">5 ms</HeartbeatInterval>'
            f"<MaxSampleSize>{_MOST_MESSAGE}</MaxSampleSize></Internal>"
            "<Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>"
        )


def check_topic(key: str, topic: str) -> None:
    """Raise ValueError for an invalid absolute name of a topic."""
    if not _NAME.fullmatch(topic):
        raise ValueError(
            f'{key} is {topic!r}: a topic begins with "/" and has letters, digits, "_" and "/", such as '
            '"/event_camera/events"'
        )  # fmt: skip


@dataclass(frozen=True)
class Ros2Link(LinkParameters):
    """Topics of ROS 2, without ROS (`pip install '.[ros2]'`): packets of events, and pictures of them.

    Attributes
    ----------
    topic : topic of `event_camera_msgs/msg/EventPacket`.
    encoding : encoding: "evt3" (4 bytes an event, and triggers) or "mono" (8).
    image_topic : topic of `sensor_msgs/msg/Image`; "": none.
    image : "display": coloured ("rgb8"). "event_image": channels ("32FC5" for five). See docs/streams.md.
    frame_ms : stream time of a picture.
    pictures : contents of a picture.
    message_ms : longest time that an event waits for others of its message.
    frame_id : name of the camera's frame in the header of each message.
    reliable : True to send lost messages again. Readers of either kind match a reliable writer.
    depth : number of messages of each topic that are stored to be sent again; a slow reader misses older ones.
    domain : ROS_DOMAIN_ID.
    interfaces : names or addresses of network interfaces; empty: this machine only. Without authentication: every
        machine there gets the events.
    peers : machines that are contacted by unicast.
    multicast : True if machines on `interfaces` find each other by multicast, as ROS 2 does by default.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "ros2"
    topic: str = "/event_camera/events"
    encoding: Literal["evt3", "mono"] = "evt3"
    image_topic: str = ""
    image: Literal["display", "event_image"] = "display"
    frame_ms: Annotated[float, Meta(ge=0.1, le=60_000)] = 20.0
    pictures: PictureSettings = field(default_factory=PictureSettings)
    message_ms: Annotated[float, Meta(ge=0.1, le=1000)] = 1.0
    frame_id: str = "event_camera"
    reliable: bool = True
    depth: Annotated[int, Meta(ge=2, le=10_000)] = 128
    domain: _Domain = 0
    interfaces: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    multicast: bool = False
    name: str = "ros2"

    def __post_init__(self) -> None:
        check_bounds(self)
        check_topic("topic", self.topic)
        if self.image_topic:
            check_topic("image_topic", self.image_topic)
        if self.pictures != PictureSettings() and not self.image_topic:
            raise ValueError("pictures needs image_topic: without one no picture is published")
        if self.image_topic == self.topic:
            raise ValueError("image_topic is that of the events: give it a name of its own")
        if not self.frame_id.isprintable() or len(self.frame_id) > 255:
            raise ValueError("frame_id must be at most 255 printable characters")
        _ = self.network

    @property
    def network(self) -> DdsNetwork:
        """Network of the topics."""
        return DdsNetwork(self.domain, self.interfaces, self.peers, self.multicast)

    def sends_evt(self) -> bool:
        """Return true for messages of EVT3 words."""
        return self.encoding == "evt3"

    def needs(self) -> tuple[Need, ...]:
        """Return the package with the DDS protocol."""
        return (package("cyclonedds"),)


_MONO_LIMIT_PX = 1 << 15


def _check(link: Ros2Link, camera: CameraFacts) -> None:
    limit = LIMIT_PX if link.encoding == "evt3" else _MONO_LIMIT_PX
    if max(camera.size) > limit:
        raise Unsuitable(f"{link.encoding} numbers {limit} columns and rows, not {camera.size[0]} x {camera.size[1]}",
                         "encoding")  # fmt: skip


ROS2 = LinkKind(Ros2Link, serves="plain", endpoint="transports.ros2.endpoint:Ros2Endpoint", check=_check)
