"""USB/IP as a link of a rig: the endpoint that serves one camera, through the faults and the trace of its cable."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field, replace
from pathlib import Path

from firmware_protocol.usb.device import UsbCamera
from transports.faults.faulty_device import FaultyDevice
from transports.link.deliveries import Deliveries
from transports.link.endpoint import REST_NS, Endpoint, EndpointFactory, EndpointReport
from transports.link.kind import Wiring
from transports.usb.kind import UsbipLink
from transports.usb.usbip.server import UsbipServer
from transports.usb.usbip.trace import UrbTrace

_TOOL_PORT = 3240  # of `usbip` without --tcp-port


@dataclass(frozen=True)
class UsbipFactory(EndpointFactory[UsbCamera]):
    """Factory of a server for the camera, which may trace its cable."""

    link: UsbipLink
    wiring: Wiring = field(default_factory=Wiring)
    trace: Path | None = None

    def traced(self, path: Path) -> UsbipFactory:
        """Return the factory of a server that traces its cable in PATH.txt and PATH.pcap."""
        return replace(self, trace=path)

    def build(self, device: UsbCamera, deliveries: Deliveries) -> UsbipEndpoint:
        """Return the server; it does not listen yet."""
        faulty = FaultyDevice(device, self.wiring.faults, deliveries.add)
        trace = None if self.trace is None else UrbTrace(self.trace, faulty, time.time_ns)
        return UsbipEndpoint(self.link, faulty, trace)


class UsbipEndpoint(Endpoint):
    """Endpoint of one camera on one port."""

    faulty: FaultyDevice
    longest_sleep_ns = REST_NS  # requests wake the event loop

    def __init__(self, link: UsbipLink, device: FaultyDevice, trace: UrbTrace | None) -> None:
        self._at = link
        self.faulty = device
        self._port = link.port
        self._is_gone = False
        self._trace = trace
        self._server = UsbipServer({link.busid: device}, allow=link.allow, observer=trace)

    async def start(self) -> None:
        """Listen; raises OSError, with the remedy, when the port cannot be opened."""
        await self._server.start(self._at.host, self._at.port)
        self._port = self._server.port

    def pump(self) -> None:
        """Answer the hosts' pending requests."""
        self._server.pump()

    def serve(self, attend: Callable[[], None]) -> None:
        """Let the server call `attend` before it processes a host's bytes."""
        self._server.attend = attend

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end faults; one that unplugs the camera removes it from the server's list."""
        self.faulty.advance(stream_us)
        if self.faulty.gone != self._is_gone:
            self._is_gone = self.faulty.gone
            (self._server.unplug if self._is_gone else self._server.plug)(self._at.busid)

    async def close(self) -> None:
        """Drop the hosts and stop listening."""
        await self._server.close()
        self.faulty.close()
        if self._trace is not None:
            self._trace.close()

    @property
    def state(self) -> str:
        """Host that holds the camera, or the address at which it is offered."""
        if self._is_gone:
            return "unplugged, by a fault"
        host = self._server.attached.get(self._at.busid)
        if host is not None:
            return f"attached by {host}"
        return f"waiting on {self._address}, bus id {self._at.busid}"

    def report(self) -> EndpointReport:
        """Return the address, the command of a Linux kernel with vhci-hcd while no host holds the camera, counts."""
        attach = ""
        if not (self._is_gone or self._at.busid in self._server.attached):
            port = f" --tcp-port {self._port}" if self._port != _TOOL_PORT else ""
            attach = f"sudo usbip{port} attach -r {self._at.host} -b {self._at.busid}"
        trouble = "" if self._trace is None else self._trace.trouble
        return EndpointReport(self._address, attach, counts=self._server.counts, trouble=trouble)

    @property
    def _address(self) -> str:
        return f"{self._at.host}:{self._port}"
