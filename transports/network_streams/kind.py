"""Parameters of streams on a network, and their registration as kinds of links."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.network_streams.coders import (
    CaerConnectionCoder,
    CaerDatagramCoder,
    ConnectionCoder,
    DatagramCoder,
    DvCoder,
    FaeryLongCoder,
    FaeryShortCoder,
    JaerCoder,
    PictureSettings,
)
from firmware_protocol.network_streams.pictures import DisplayCoder, EventImageCoder
from firmware_protocol.network_streams.words import WORD_CONNECTION_CODERS, WORD_DATAGRAM_CODERS
from transports.link.kind import EVENT_OCTETS, CameraFacts, LinkKind, LinkParameters, Port, check_size
from transports.needs import Need, package
from transports.network import DatagramRate, DestinationPort, check_allow, check_destination


@dataclass(frozen=True)
class TcpLink(LinkParameters):
    """A server that sends events to all its clients: the DV viewer, `dv_processing.io.NetworkReader`, clients of cAER.

    Attributes
    ----------
    format : "dv": AEDAT 4.0 packets of dv-processing. "caer": AEDAT 3.1 packets of cAER. "event_image": numpy arrays.
        "display": coloured pictures (PPM). "evt2", "evt21", "evt3", "spif": a sensor's words. See docs/streams.md.
    host, port : address to listen on; port 0: a free one. Without authentication: any permitted client gets the events.
    allow : addresses and networks that may connect; required if other machines can reach `host`.
    buffer_mib : limit of the data that wait for one client; a paced run drops what has no room.
    compression : compression of the format dv; "lz4" needs `pip install '.[files]'`.
    trigger_port : with the format dv: port of a second server, for triggers, because dv-processing reads one stream
        from a connection; 0: a free one. Omitted: none.
    frame_ms : stream time of an event image or a picture of the display.
    pictures : contents of the pictures.
    camera : name of the camera that is sent to clients; "" for the model's and the rig's serial number.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "tcp"
    format: Literal["dv", "caer", "event_image", "display", "evt2", "evt21", "evt3", "spif"] = "dv"
    host: str = "127.0.0.1"
    port: Port = 7777
    allow: tuple[str, ...] = ()
    buffer_mib: Annotated[float, Meta(ge=0.0625, le=1024)] = 8.0
    compression: Literal["none", "lz4"] = "none"
    trigger_port: int | None = None
    frame_ms: Annotated[float, Meta(ge=0.1, le=60_000)] = 20.0
    pictures: PictureSettings = field(default_factory=PictureSettings)
    camera: str = ""
    name: str = "tcp"

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.format != "dv" and (self.compression != "none" or self.trigger_port is not None):
            key = "compression" if self.compression != "none" else "trigger_port"
            raise ValueError(f'{key} is of the format "dv"; {self.format} has none')
        if not 0 <= (self.trigger_port or 0) <= 65535:
            raise ValueError(f"trigger_port must be 0 to 65535, got {self.trigger_port}")
        if self.port and self.trigger_port == self.port:
            raise ValueError("trigger_port is that of the events: give it another one")
        if self.pictures != PictureSettings() and self.format not in ("event_image", "display"):
            raise ValueError(f'pictures is of the formats "event_image" and "display"; {self.format} shows none')
        check_allow(self.host, self.allow)

    def listens_on(self) -> tuple[str, int] | None:
        """Return the address, unless any free port is suitable."""
        return (self.host, self.port) if self.port else None

    def sends_evt(self) -> bool:
        """Return true if the format is one of EVT words."""
        return self.format.startswith("evt")

    def needs(self) -> tuple[Need, ...]:
        """Return the package that compresses."""
        return (package("lz4"),) if self.compression == "lz4" else ()


@dataclass(frozen=True)
class UdpLink(LinkParameters):
    """Datagrams of events to one address: jAER, cAER, AEStream, faery.

    Attributes
    ----------
    format : "jaer", "caer", faery's "t64_x16_y16_on8" or "t32_x16_y15_on1", or a sensor's words: "spif" (AEStream),
        "evt2", "evt21", "evt3". See docs/streams.md.
    host, port : address of the receiver. jAER listens on 8991.
    elsewhere : must be true if `host` is not on this machine, which then gets events even unrequested.
    mbit_s : highest rate, Mbit/s of payload: receivers lose data that arrive faster than they read. At 8 bytes an
        event, 200 Mbit/s are 3.1 million events a second.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "udp"
    format: Literal["jaer", "caer", "spif", "t64_x16_y16_on8", "t32_x16_y15_on1", "evt2", "evt21", "evt3"] = "jaer"
    host: str = "127.0.0.1"
    port: DestinationPort = 8991
    elsewhere: bool = False
    mbit_s: DatagramRate = 200.0
    name: str = "udp"

    def __post_init__(self) -> None:
        check_bounds(self)
        check_destination(self.host, elsewhere=self.elsewhere)

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that its highest rate carries."""
        return self.mbit_s * 1e6 / 8 / EVENT_OCTETS[self.format]

    def sends_evt(self) -> bool:
        """Return true if the format is one of EVT words."""
        return self.format.startswith("evt")


CONNECTION_CODERS: Mapping[str, type[ConnectionCoder]] = {
    "dv": DvCoder,
    "caer": CaerConnectionCoder,
    "event_image": EventImageCoder,
    "display": DisplayCoder,
    **WORD_CONNECTION_CODERS,
}
DATAGRAM_CODERS: Mapping[str, type[DatagramCoder]] = {
    "jaer": JaerCoder,
    "caer": CaerDatagramCoder,
    "t64_x16_y16_on8": FaeryLongCoder,
    "t32_x16_y15_on1": FaeryShortCoder,
    **WORD_DATAGRAM_CODERS,
}


TCP = LinkKind(
    TcpLink,
    serves="plain",
    endpoint="transports.network_streams.tcp:TcpEndpoint",
    check=lambda link, camera: check_size(link.format, CONNECTION_CODERS[link.format].limit_px, camera),
)

UDP = LinkKind(
    UdpLink,
    serves="plain",
    endpoint="transports.network_streams.udp:UdpEndpoint",
    check=lambda link, camera: check_size(link.format, DATAGRAM_CODERS[link.format].limit_px, camera),
)
