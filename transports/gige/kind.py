"""Parameters of a GigE Vision link, and its registration as a kind of link."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import Annotated, ClassVar

from msgspec import Meta

from firmware_protocol.bounds import check_bounds
from firmware_protocol.gige.gvcp import GVCP_PORT
from transports.faults.kinds import GIGE_STREAM
from transports.link.kind import EVENT_OCTETS, CameraFacts, LinkKind, LinkParameters, Listener, Port, Unsuitable
from transports.network import check_allow


@dataclass(frozen=True)
class GigeLink(LinkParameters):
    """The camera as a GigE Vision device on a network: drivers find it and read it over UDP.

    Attributes
    ----------
    host : IPv4 address of the camera. Several cameras on one machine need several: 127.0.0.1, 127.0.0.2, ...
    port : port of the control channel: 3956, which all drivers use; another, or 0 for a free one, is for tests.
    allow : addresses and networks that may find, control and receive; required if other machines can reach `host`.
    mbit_s : highest rate of the stream, Mbit/s: hosts lose data that arrive faster than they read. 1000 as the real
        camera's cable.
    segmentation : True: the kernel or the network card divides blocks into packets (UDP segmentation). On loopback and
        veth, programs that read raw sockets, such as Aravis run by root, see undivided blocks.
    block_us : age at which a block is closed and sent, if it was not full before.
    reserved_words : True: blocks have the words without events that the real camera sends: 0xE0FF after the first time,
        and 0x9999 as padding.
    ptp : True: the host can have the camera follow a PTP master (IEEE 1588; feature PtpEnable). Needs UDP ports 319 and
        320 (root or CAP_NET_BIND_SERVICE).
    ptp_domain : domain of that protocol.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "gige"
    host: str = "127.0.0.1"
    port: Port = GVCP_PORT
    allow: tuple[str, ...] = ()
    mbit_s: Annotated[float, Meta(ge=1, le=100_000)] = 1000.0
    segmentation: bool = False
    block_us: Annotated[int, Meta(ge=1, le=1_000_000)] = 1000
    reserved_words: bool = True
    ptp: bool = False
    ptp_domain: Annotated[int, Meta(ge=0, le=127)] = 0
    name: str = "gige"

    def __post_init__(self) -> None:
        try:
            ipaddress.IPv4Address(self.host)
        except ValueError as error:
            raise ValueError(f"host must be an IPv4 address of this machine, got {self.host!r}") from error
        if ipaddress.IPv4Address(self.host).is_unspecified:
            raise ValueError(
                "host 0.0.0.0 is not an address that a camera can report: give one address of this machine"
            )
        check_bounds(self)
        check_allow(self.host, self.allow)

    def listens_on(self) -> tuple[str, int] | None:
        """Return the address, unless any free port is suitable."""
        return (self.host, self.port) if self.port else None

    def carries_hz(self, camera: CameraFacts) -> float:
        """Return the events a second that its highest rate carries."""
        return self.mbit_s * 1e6 / 8 / EVENT_OCTETS["evt3"]

    def sends_evt(self) -> bool:
        """Return true: its blocks contain EVT3 words."""
        return True


def _check(link: GigeLink, camera: CameraFacts) -> None:
    """Raise Unsuitable for a camera without a GigE Vision device."""
    if not camera.has_gige:
        models = " or ".join(f'model = "{name}"' for name in camera.gige_models())
        raise Unsuitable(f"a {camera.model} has no Ethernet plug; use {models}", "kind")


GIGE = LinkKind(
    GigeLink,
    serves="gige",
    endpoint="transports.gige.endpoint:GigeEndpoint",
    carrier=GIGE_STREAM,
    listener=Listener("gige", "Read a GigE Vision event camera.", "emulator.cli.listen.cameras:gige"),
    check=_check,
)
