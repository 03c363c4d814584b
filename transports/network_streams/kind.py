"""The records of streams on a network."""

from __future__ import annotations

from collections.abc import Mapping
from functools import partial
from typing import Any

from firmware_protocol.network_streams.caer import CaerConnectionCoder, CaerDatagramCoder
from firmware_protocol.network_streams.coder import ConnectionCoder, DatagramCoder, StreamFacts
from firmware_protocol.network_streams.dv import DvCoder, DvTriggerCoder
from firmware_protocol.network_streams.jaer import JaerCoder
from firmware_protocol.network_streams.pictures import DisplayCoder, EventImageCoder
from firmware_protocol.network_streams.plain_datagrams import FaeryLongCoder, FaeryShortCoder, SpifCoder
from transports.link.endpoint import EndpointFactory
from transports.link.kind import CameraFacts, LinkKind, Unsuitable, Wiring
from transports.needs import package
from transports.network_streams.parameters import TcpStream, UdpStream

__all__ = ["TCP", "UDP"]

_CONNECTION_CODERS: Mapping[str, type[ConnectionCoder]] = {
    "dv": DvCoder,
    "caer": CaerConnectionCoder,
    "event_image": EventImageCoder,
    "display": DisplayCoder,
}
_DATAGRAM_CODERS: Mapping[str, type[DatagramCoder]] = {
    "jaer": JaerCoder,
    "caer": CaerDatagramCoder,
    "spif": SpifCoder,
    "t64_x16_y16_on8": FaeryLongCoder,
    "t32_x16_y15_on1": FaeryShortCoder,
}


def _tcp_endpoint(link: TcpStream, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.network_streams.tcp import TcpFactory

    camera = link.camera or wiring.camera.model.upper()
    facts = StreamFacts(wiring.camera.size, camera, round(link.frame_ms * 1000), link.compression, link.pictures)
    triggers = None if link.trigger_port is None else partial(DvTriggerCoder, facts)
    return TcpFactory(link, partial(_CONNECTION_CODERS[link.format], facts), triggers)


def _udp_endpoint(link: UdpStream, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.network_streams.udp import UdpFactory

    facts = StreamFacts(wiring.camera.size, wiring.camera.model.upper())
    return UdpFactory(link, partial(_DATAGRAM_CODERS[link.format], facts))


def _check_tcp(link: TcpStream, camera: CameraFacts) -> None:
    _check_size(link.format, _CONNECTION_CODERS[link.format].limit_px, camera)


def _check_udp(link: UdpStream, camera: CameraFacts) -> None:
    _check_size(link.format, _DATAGRAM_CODERS[link.format].limit_px, camera)


def _check_size(form: str, limit_px: tuple[int, int], camera: CameraFacts) -> None:
    if camera.size[0] > limit_px[0] or camera.size[1] > limit_px[1]:
        raise Unsuitable(
            f"{form} numbers {limit_px[0]} x {limit_px[1]} pixels, not {camera.size[0]} x {camera.size[1]}", "format"
        )


TCP = LinkKind(
    TcpStream,
    serves="plain",
    endpoint=_tcp_endpoint,
    check=_check_tcp,
    listens_on=lambda link: (link.host, link.port) if link.port else None,
    needs=lambda link: (package("lz4"),) if link.compression == "lz4" else (),
)

UDP = LinkKind(UdpStream, serves="plain", endpoint=_udp_endpoint, check=_check_udp)
