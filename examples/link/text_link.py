"""A link, complete: events as lines of text in UDP datagrams, "t_us x y polarity" with polarity 1 for ON.

UDP has no back-pressure: an event counts as delivered when the kernel has taken its datagram.
"""

from __future__ import annotations

import socket
from dataclasses import dataclass
from typing import ClassVar

from firmware_protocol.device.plain_device import PlainDevice, own_time
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint
from transports.link.kind import LinkKind, LinkParameters, Wiring

MOST_EVENTS = 50  # in a datagram: their lines fit a packet of Ethernet


@dataclass(frozen=True)
class TextLink(LinkParameters):
    """Lines of text to one address.

    Attributes
    ----------
    host, port
        Address of the receiver.
    name
        Name of the link in this rig.
    """

    kind: ClassVar[str] = "text"
    host: str = "127.0.0.1"
    port: int = 9000
    name: str = "text"


class TextEndpoint(Endpoint):
    def __init__(self, link: TextLink, wiring: Wiring, device: PlainDevice, deliveries: Deliveries) -> None:
        self._address = (link.host, link.port)
        self._device = device
        self._deliveries = deliveries
        self._sent = 0
        device.takes_edges = False  # a line is an event

    async def start(self) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)

    def pump(self) -> None:
        while (items := self._device.take(MOST_EVENTS)) is not None:
            events = own_time(items.events, items.epoch_us)
            lines = "".join(f"{t} {x} {y} {int(on)}\n" for t, x, y, on in events.tolist())
            try:
                self._socket.sendto(lines.encode(), self._address)
            except OSError:  # no room, or no way to the address
                self._device.lost(items)
                continue
            self._device.sent(items)
            self._deliveries.add(items.events, items.epoch_us)
            self._sent += len(events)

    async def close(self) -> None:
        self._device.run(False)
        self._socket.close()

    @property
    def state(self) -> str:
        return f"{self._sent} lines to {self._address[0]}:{self._address[1]}"


TEXT = LinkKind(TextLink, serves="plain", endpoint="text_link:TextEndpoint")
