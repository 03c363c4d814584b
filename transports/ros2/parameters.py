"""What a rig says of topics of ROS 2."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from firmware_protocol.network_streams.picture_settings import PictureSettings
from transports.ros2.network import DdsNetwork, check_topic

__all__ = ["Ros2Topics"]


@dataclass(frozen=True)
class Ros2Topics:
    """Topics of ROS 2, without ROS (`pip install '.[ros2]'`): packets of events, and pictures of them.

    Attributes
    ----------
    topic
        Topic of `event_camera_msgs/msg/EventPacket`.
    encoding
        Of the events: "evt3" (4 bytes an event, and triggers) or "mono" (8 bytes an event).
    image_topic
        Topic of `sensor_msgs/msg/Image`; "": none.
    image
        "display": coloured ("rgb8"). "event_image": channels ("32FC5" for five). See docs/streams.md.
    frame_ms
        Stream time of a picture.
    pictures
        What a picture shows.
    message_ms
        Longest time that an event waits for others of its message.
    frame_id
        Name of the camera's frame in the header of each message.
    reliable
        Whether a message that is lost on its way is sent again. Readers of either kind match a reliable writer.
    depth
        Messages of each topic that are kept to be sent again; a slow reader misses older ones.
    domain
        ROS_DOMAIN_ID.
    interfaces
        Names or addresses of network interfaces to use; empty: only programs on this machine. There is no
        authentication: whoever is in reach has the events.
    peers
        Machines that are asked by unicast.
    multicast
        Whether machines on `interfaces` find each other by multicast, as ROS 2 does by default.
    name
        What this rig calls the link: in reports, and where triggers name it.
    """

    kind: ClassVar[str] = "ros2"
    topic: str = "/event_camera/events"
    encoding: Literal["evt3", "mono"] = "evt3"
    image_topic: str = ""
    image: Literal["display", "event_image"] = "display"
    frame_ms: float = 20.0
    pictures: PictureSettings = field(default_factory=PictureSettings)
    message_ms: float = 1.0
    frame_id: str = "event_camera"
    reliable: bool = True
    depth: int = 128
    domain: int = 0
    interfaces: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    multicast: bool = False
    name: str = "ros2"

    def __post_init__(self) -> None:
        check_topic("topic", self.topic)
        if self.image_topic:
            check_topic("image_topic", self.image_topic)
        if self.pictures != PictureSettings() and not self.image_topic:
            raise ValueError("pictures needs image_topic: without one no picture is published")
        if self.image_topic == self.topic:
            raise ValueError("image_topic is that of the events: give it a name of its own")
        bounds = {"frame_ms": (0.1, 60_000), "message_ms": (0.1, 1000), "depth": (2, 10_000)}
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be {low:g} to {high:g}, got {getattr(self, name)}")
        if not self.frame_id.isprintable() or len(self.frame_id) > 255:
            raise ValueError("frame_id must be at most 255 printable characters")
        _ = self.network

    @property
    def network(self) -> DdsNetwork:
        """Where the topics are exchanged."""
        return DdsNetwork(self.domain, self.interfaces, self.peers, self.multicast)
