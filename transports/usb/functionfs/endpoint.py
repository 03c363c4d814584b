"""USB gadget of this machine as a link's endpoint."""

from __future__ import annotations

import logging
import signal
from collections.abc import Callable
from contextlib import suppress

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import UsbCamera
from firmware_protocol.usb.functionfs import NO_STRINGS, descriptor_block
from transports.faults.faulty_device import FaultyDevice
from transports.link.deliveries import Deliveries
from transports.link.endpoint import REST_NS, Endpoint, EndpointReport, LinkBroken
from transports.link.kind import Wiring
from transports.usb.functionfs.cable import Cable
from transports.usb.functionfs.files import WAKE_SIGNAL, FunctionFiles, with_spares
from transports.usb.functionfs.gadget import Gadget, GadgetError, Places, controller_of
from transports.usb.kind import UsbGadgetLink

log = logging.getLogger(__name__)

_SPEEDS = (Speed.FULL, Speed.HIGH, Speed.SUPER)


class GadgetEndpoint(Endpoint):
    """Endpoint of one camera at one controller."""

    faulty: FaultyDevice
    longest_sleep_ns = REST_NS  # requests wake the event loop

    def __init__(self, link: UsbGadgetLink, wiring: Wiring, camera: UsbCamera, deliveries: Deliveries) -> None:
        self._camera = camera
        self.faulty = FaultyDevice(camera, wiring.faults, deliveries.add)
        self._udc = link.udc
        self._gadget = Gadget(link.gadget)
        self._is_mine = self._is_gone = self._had_host = False
        self._cable: Cable | None = None
        self._files: FunctionFiles | None = None
        self._trouble = ""

    async def start(self) -> None:
        """Make the gadget if it does not exist, and connect it; raises OSError with the remedy."""
        controller = self._udc = controller_of(self._udc, Places())
        signal.signal(WAKE_SIGNAL, lambda *_: None)
        self._prepare()
        try:
            self._files = self._open(controller)
            self._cable = Cable(self.faulty, self._files)
            self._cable.start()
            self._gadget.bind(controller)
        except OSError:
            await self.close()
            raise

    def pump(self) -> None:
        """Send the camera's data to the host."""
        if self._cable is not None:
            self._cable.pump()
            if self._cable.enabled != self._had_host:
                self._had_host = self._cable.enabled
                self._check_addresses()

    def serve(self, attend: Callable[[], None]) -> None:
        """Let the cable call `attend` before it processes a request."""
        if self._cable is not None:
            self._cable.attend = attend

    def advance_faults(self, stream_us: int) -> None:
        """Begin and end faults; one that unplugs the camera disconnects the gadget."""
        self.faulty.advance(stream_us)
        if self.faulty.gone != self._is_gone:
            self._is_gone = self.faulty.gone
            self._plug(connected=not self._is_gone)

    async def close(self) -> None:
        """Disconnect the camera from its host, and remove the gadget if this link made it."""
        try:
            if self._cable is not None:
                await self._cable.close(self._gadget.unbind)
        except GadgetError as error:
            log.warning("%s; it is disconnected by closing its files", error)
        if self._files is not None:
            self._files.close()
        self.faulty.close()
        if self._is_mine:
            self._remove()

    @property
    def state(self) -> str:
        """State of the connection to a host."""
        if self._is_gone:
            return "unplugged, by a fault"
        if self._cable is not None and self._cable.enabled:
            return f"{self._trouble or 'plugged in'} at {self._udc}"
        return f"waiting for a host at {self._udc}"

    def report(self) -> EndpointReport:
        """Return the name of the controller."""
        return EndpointReport(self._udc)

    def _plug(self, *, connected: bool) -> None:
        """Connect the gadget to its controller, or disconnect it; raises LinkBroken."""
        try:
            if connected:
                self._gadget.bind(self._udc)
            else:
                self._gadget.unbind()
        except GadgetError as error:
            raise LinkBroken(str(error)) from error

    def _prepare(self) -> None:
        """Make the gadget, if there is no suitable one; raises GadgetError."""
        descriptors = self._camera.descriptors(self._camera.identity.speed)
        gadget = self._gadget
        if gadget.is_ready and not gadget.controller and gadget.suits(descriptors):
            return
        gadget.make(descriptors)
        self._is_mine = True

    def _remove(self) -> None:
        try:
            self._gadget.remove()
        except GadgetError as error:
            log.warning("%s; `evstim gadget down --name %s` will", error, self._gadget.name)

    def _open(self, controller: str) -> FunctionFiles:
        """Write the camera's interface to the kernel; raises OSError."""
        configurations = {speed: self._camera.descriptors(speed).configuration for speed in _SPEEDS}
        try:
            interfaces = {speed: with_spares(configurations[speed].interfaces[0], controller) for speed in _SPEEDS}
        except ValueError as error:
            raise GadgetError(str(error)) from error
        places = {place: endpoint.address for place, endpoint in enumerate(interfaces[Speed.FULL].endpoints, 1)}
        of_camera = configurations[Speed.FULL].endpoint_addresses
        used = {place: address for place, address in places.items() if address in of_camera}
        try:
            return FunctionFiles(self._gadget.mount, (descriptor_block(interfaces), NO_STRINGS), used)
        except OSError as error:
            raise GadgetError(
                f"cannot give the kernel the camera's interface in {self._gadget.mount}: {error}; `evstim gadget down` "
                "removes what is wrong there"
            ) from error

    def _check_addresses(self) -> None:
        """Check that the controller assigned the endpoints that the camera's drivers use; log a warning if not."""
        if self._files is None or not self._had_host:
            return
        with suppress(OSError):  # the host may be lost again
            wrong = {address: assigned for address, assigned in self._files.given.items() if address != assigned}
            pairs = ", ".join(f"0x{assigned:02X} for 0x{address:02X}" for address, assigned in wrong.items())
            self._trouble = f"wrong endpoints ({pairs})" if wrong else ""
            if wrong:
                log.warning("%s gives endpoint %s: drivers of this camera will not find them", self._udc, pairs)
