"""The USB/IP server as a link's endpoint."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

from firmware_protocol.usb.device import UsbCamera
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, FaultRecord
from transports.faults.usb import FaultyDevice
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.usb.observed import Observed
from transports.usb.usbip.server import UsbipServer
from transports.usb.usbip.trace import UrbTrace

__all__ = ["UsbipEndpoint", "UsbipFactory"]


@dataclass(frozen=True)
class UsbipFactory(EndpointFactory[UsbCamera]):
    """Serves the camera under `busid` at `host`:`port` (port 0: any free one) to those whom `allow` names."""

    host: str
    port: int
    busid: str
    faults: FaultPlan = field(default_factory=FaultPlan)
    allow: tuple[str, ...] = ()
    trace: Path | None = None

    def traced(self, path: Path) -> UsbipFactory:
        """See `EndpointFactory.traced`."""
        return replace(self, trace=path)

    def build(self, device: UsbCamera, deliveries: Deliveries) -> UsbipEndpoint:
        """Return the server, not yet listening."""
        faulty = FaultyDevice(device, self.faults)
        trace = None if self.trace is None else UrbTrace(self.trace, faulty, time.time_ns)
        return UsbipEndpoint(self, faulty, deliveries, trace)


class UsbipEndpoint(Endpoint):
    """One camera on one port."""

    def __init__(
        self, factory: UsbipFactory, device: FaultyDevice, deliveries: Deliveries, trace: UrbTrace | None
    ) -> None:
        self._at = factory
        self._device = device
        self._is_gone = False
        self._trace = trace
        observed = Observed(device, deliveries)
        self._server = UsbipServer({factory.busid: observed}, allow=factory.allow, observer=trace)

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

    def advance_faults(self, stream_us: int) -> None:
        """See `Endpoint.advance_faults`."""
        self._device.advance(stream_us)
        if self._device.gone != self._is_gone:
            self._is_gone = self._device.gone
            (self._server.unplug if self._is_gone else self._server.plug)(self._at.busid)

    def inject(self, fault: Fault) -> None:
        """See `Endpoint.inject`."""
        self._device.inject(fault)

    @property
    def withholds(self) -> bool:
        """See `Endpoint.withholds`."""
        return self._device.silent

    @property
    def faults(self) -> tuple[FaultRecord, ...]:
        """See `Endpoint.faults`."""
        return self._device.records

    async def close(self) -> None:
        """Drop the hosts and stop listening."""
        await self._server.close()
        self._device.close()
        if self._trace is not None:
            self._trace.close()

    @property
    def state(self) -> str:
        """Who holds the camera, or where it can be had."""
        if self._is_gone:
            return "unplugged, by a fault"
        host = self._server.attached.get(self._at.busid)
        if host is not None:
            return f"attached by {host}"
        return f"waiting on {self.address}, bus id {self._at.busid}"

    @property
    def address(self) -> str:
        """Host and port that the server listens on."""
        return f"{self._at.host}:{self._server.port}"

    @property
    def trouble(self) -> str:
        """See `Endpoint.trouble`: why the trace is not whole."""
        return "" if self._trace is None else self._trace.trouble

    @property
    def counts(self) -> Mapping[str, int]:
        """Connections that were refused, or closed for newer ones."""
        return self._server.counts
