"""The USB/IP server as a link's endpoint."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.usb.device import UsbCamera, UsbDevice
from transports.deliveries import Deliveries
from transports.link import Endpoint, EndpointFactory
from transports.observed import Observed
from transports.usbip.server import UsbipServer

__all__ = ["UsbipEndpoint", "UsbipFactory"]


@dataclass(frozen=True)
class UsbipFactory(EndpointFactory[UsbCamera]):
    """Serves the camera under `busid` at `host`:`port` (port 0: any free one)."""

    host: str
    port: int
    busid: str

    def build(self, device: UsbCamera, deliveries: Deliveries) -> UsbipEndpoint:
        """Return the server, not yet listening."""
        return UsbipEndpoint(self, Observed(device, deliveries))


class UsbipEndpoint(Endpoint):
    """One camera on one port."""

    def __init__(self, factory: UsbipFactory, device: UsbDevice) -> None:
        self._at = factory
        self._server = UsbipServer({factory.busid: device})

    async def start(self) -> None:
        """Listen; raises OSError, with what to do, when the port cannot be had."""
        try:
            await self._server.start(self._at.host, self._at.port)
        except OSError as error:
            raise OSError(
                error.errno,
                f"cannot listen on {self._at.host} port {self._at.port}: {error.strerror}; another evstim or usbipd "
                "may hold it: stop that one, or give this link another port (0 takes a free one)",
            ) from error

    def pump(self) -> None:
        """Answer the hosts' pending requests."""
        self._server.pump()

    async def close(self) -> None:
        """Drop the hosts and stop listening."""
        await self._server.close()

    @property
    def state(self) -> str:
        """Who holds the camera, or where it can be had."""
        host = self._server.attached.get(self._at.busid)
        if host is not None:
            return f"attached by {host}"
        return f"waiting on {self.address}, bus id {self._at.busid}"

    @property
    def address(self) -> str:
        """Host and port that the server listens on."""
        return f"{self._at.host}:{self._server.port}"
