"""A USB bus in memory behind pyusb: the real camera model, the real pyusb classes, no cable, no server and no root.

    with FakeCamera() as camera:
        device = camera.device                     # a usb.core.Device; or usb.core.find(backend=camera.bus)
        driver_under_test(device)
        camera.show(events)                        # EVENT array, stream time
        device.read(0x82, 65536)

`FakeUsbBus` is a backend of pyusb that has one device on its bus. Requests that fail, fail as on a real bus:
`break_with(errno.ENODEV)` is a cable that was pulled.

Not modelled: time on a wire, packets, other devices. A read returns what the camera has within its timeout,
one transfer at a time. Faults (`transports.faults.faulty_device.FaultyDevice`) and another camera go in by
`FakeUsbBus(device, descriptors)`; it keeps the contract of `evstim.testing.usb_contract`, as the USB/IP server does.
"""

from __future__ import annotations

import array
import errno
import threading
from collections.abc import Callable
from contextlib import suppress
from types import SimpleNamespace
from typing import Any, ParamSpec, Self, TypeVar

import usb.backend
import usb.core
import usb.util

from firmware_protocol.davis346.device import Davis346, Davis346Settings
from firmware_protocol.events import Events
from firmware_protocol.usb.descriptors import DescriptorSet, Speed
from firmware_protocol.usb.device import NotReady, SetupPacket, Stall, Transfer, UsbDevice

_PYUSB_SPEED = {Speed.LOW: 1, Speed.FULL: 2, Speed.HIGH: 3, Speed.SUPER: 4}

P = ParamSpec("P")
R = TypeVar("R")


class FakeUsbBus(usb.backend.IBackend):  # type: ignore[misc]  # pyusb has no types
    """A libusb that has one device, or one fault, on its bus; any thread may use it."""

    def __init__(self, device: UsbDevice, descriptors: DescriptorSet) -> None:
        self.device = device
        self.changed = threading.Condition(threading.RLock())
        self.fault: int | None = None
        self._descriptors = descriptors

    def call(self, function: Callable[P, R], *args: P.args, **kwargs: P.kwargs) -> R:
        """Do something to the device, as the process that owns it would."""
        with self.changed:
            result = function(*args, **kwargs)
            self.changed.notify_all()
            return result

    def break_with(self, number: int | None) -> None:
        """Let every request fail with this errno from now on; None: mend the bus."""
        with self.changed:
            self.fault = number
            self.changed.notify_all()

    # --- the methods of a backend, by pyusb's names (usb/backend/__init__.py)

    def enumerate_devices(self) -> list[str]:
        """Return the handle of the one device."""
        return ["handle"]

    def get_device_descriptor(self, dev: object) -> SimpleNamespace:
        """Return the fields of the device descriptor."""
        fields, identity = bytes(self._descriptors.device), self.device.identity
        return SimpleNamespace(
            bLength=18, bDescriptorType=1, bcdUSB=int.from_bytes(fields[2:4], "little"),
            bDeviceClass=fields[4], bDeviceSubClass=fields[5], bDeviceProtocol=fields[6], bMaxPacketSize0=fields[7],
            idVendor=identity.vendor_id, idProduct=identity.product_id, bcdDevice=identity.bcd_device,
            iManufacturer=fields[14], iProduct=fields[15], iSerialNumber=fields[16], bNumConfigurations=1,
            address=2, bus=1, port_number=1, port_numbers=(1,), speed=_PYUSB_SPEED[identity.speed],
        )  # fmt: skip

    def get_configuration_descriptor(self, dev: object, config: int) -> SimpleNamespace:
        """Return the fields of the one configuration."""
        fields = bytes(self._descriptors.configuration)
        return SimpleNamespace(
            bLength=9, bDescriptorType=2, wTotalLength=len(fields), bNumInterfaces=fields[4],
            bConfigurationValue=fields[5], iConfiguration=fields[6], bmAttributes=fields[7], bMaxPower=fields[8],
            extra_descriptors=[],
        )  # fmt: skip

    def get_interface_descriptor(self, dev: object, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the fields of an interface; raises IndexError for an alternate setting, which there is none of."""
        if alt:
            raise IndexError
        interface = self._descriptors.configuration.interfaces[intf]
        kind, subclass, protocol = interface.interface_class
        return SimpleNamespace(
            bLength=9, bDescriptorType=4, bInterfaceNumber=interface.number, bAlternateSetting=0,
            bNumEndpoints=len(interface.endpoints), bInterfaceClass=kind, bInterfaceSubClass=subclass,
            bInterfaceProtocol=protocol, iInterface=0, extra_descriptors=[],
        )  # fmt: skip

    def get_endpoint_descriptor(self, dev: object, ep: int, intf: int, alt: int, config: int) -> SimpleNamespace:
        """Return the fields of an endpoint of an interface."""
        endpoint = self._descriptors.configuration.interfaces[intf].endpoints[ep]
        return SimpleNamespace(
            bLength=7, bDescriptorType=5, bEndpointAddress=endpoint.address, bmAttributes=int(endpoint.transfer_type),
            wMaxPacketSize=endpoint.max_packet, bInterval=endpoint.interval, bRefresh=0, bSynchAddress=0,
            extra_descriptors=[],
        )  # fmt: skip

    def open_device(self, dev: object) -> str:
        """Attach a host to the device."""
        self._check()
        self.call(self.device.attached)
        return "open"

    def close_device(self, dev_handle: object) -> None:
        """Detach the host from the device."""
        self.call(self.device.detached)

    def get_configuration(self, dev_handle: object) -> int:
        """Return 0: no configuration is set until a host sets one."""
        return 0

    def set_configuration(self, dev_handle: object, config_value: int) -> None:
        """Send the request SET_CONFIGURATION."""
        self._request(SetupPacket(0x00, 9, config_value, 0, 0))

    def claim_interface(self, dev_handle: object, intf: int) -> None:
        """Do nothing, but fail where the bus is broken."""
        self._check()

    def release_interface(self, dev_handle: object, intf: int) -> None:
        """Do nothing: no other program has the device."""

    def clear_halt(self, dev_handle: object, ep: int) -> None:
        """Send the request CLEAR_FEATURE(ENDPOINT_HALT)."""
        self._request(SetupPacket(0x02, 1, 0, ep, 0))

    def ctrl_transfer(
        self, dev_handle: object, bmRequestType: int, bRequest: int, wValue: int, wIndex: int, *data_and_timeout: Any
    ) -> int:
        """Send a control request; the last two are an array.array of bytes, for the reply, and a timeout, ms."""
        data, timeout = data_and_timeout
        setup = SetupPacket(bmRequestType, bRequest, wValue, wIndex, len(data))
        reply = self._request(setup, b"" if setup.is_in else data.tobytes(), timeout * 1e-3)
        if not setup.is_in:
            return len(data)
        data[: len(reply)] = array.array("B", reply)
        return len(reply)

    def bulk_read(self, dev_handle: object, ep: int, intf: int, buff: Any, timeout: float) -> int:
        """Read from an IN endpoint into `buff`, and return the number of bytes; `timeout` in ms."""
        with self.changed:
            transfer = self._wait_for_data(ep & 15, len(buff), timeout * 1e-3)
            buff[: len(transfer.data)] = array.array("B", transfer.data)
            self.device.sent(transfer)
        return len(transfer.data)

    def bulk_write(self, dev_handle: object, ep: int, intf: int, data: Any, timeout: float) -> int:
        """Write data to an OUT endpoint; `timeout` is not used, as the device takes all at once."""
        with self.changed:
            self._check()
            try:
                self.device.write(ep, data.tobytes())
            except Stall as stall:
                raise usb.core.USBError("stall", None, errno.EPIPE) from stall
            self.changed.notify_all()
        return len(data)

    def intr_read(self, dev_handle: object, ep: int, intf: int, buff: Any, timeout: float) -> int:
        """Read as `bulk_read` does: the device makes no difference."""
        return self.bulk_read(dev_handle, ep, intf, buff, timeout)

    def _wait_for_data(self, endpoint: int, most_bytes: int, timeout_s: float) -> Transfer:
        transfers: list[Transfer] = []

        def ready() -> bool:
            if self.fault is None and (transfer := self._read(endpoint, most_bytes)) is not None:
                transfers.append(transfer)
            return bool(transfers) or self.fault is not None

        if not self.changed.wait_for(ready, timeout_s):
            raise usb.core.USBTimeoutError("timeout", None, errno.ETIMEDOUT)
        self._check()
        return transfers[0]

    def _read(self, endpoint: int, most_bytes: int) -> Transfer | None:
        try:
            return self.device.read(endpoint, most_bytes)
        except Stall as stall:
            raise usb.core.USBError("stall", None, errno.EPIPE) from stall

    def _request(self, setup: SetupPacket, data: bytes = b"", timeout_s: float = 1.0) -> bytes:
        replies: list[bytes] = []

        def answered() -> bool:
            self._check()
            with suppress(NotReady):
                replies.append(self.device.control(setup, data))
            return bool(replies)

        with self.changed:
            try:
                if not self.changed.wait_for(answered, timeout_s):
                    raise usb.core.USBTimeoutError("timeout", None, errno.ETIMEDOUT)
            except Stall as stall:
                raise usb.core.USBError("stall", None, errno.EPIPE) from stall
            self.changed.notify_all()
        return replies[0]

    def _check(self) -> None:
        if self.fault is not None:
            raise usb.core.USBError("fault", None, self.fault)


class FakeCamera:
    """A DAVIS346 on a bus in memory; a context manager that detaches it at the end.

    Parameters
    ----------
    settings : of the camera; by default it starts at once, without the silence that real drivers need.

    Attributes
    ----------
    bus : the backend, for `usb.core.find(backend=...)`.
    model : the camera behind it, with `counters`.
    device : the camera as pyusb's Device.
    """

    def __init__(self, settings: Davis346Settings | None = None) -> None:
        self.model = Davis346(settings or Davis346Settings(start_delay_us=0))
        self.bus = FakeUsbBus(self.model, self.model.settings.descriptors())
        self.device: usb.core.Device = usb.core.find(backend=self.bus)
        self._t_us = 0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.break_with(None)
        usb.util.dispose_resources(self.device)

    def show(self, events: Events, until_us: int | None = None) -> None:
        """Give the camera events (n,) EVENT of stream time, sorted, and let time go on to `until_us` (their last).

        As in a real camera, events that come while no driver has it running, or that find its buffer full, are lost
        and counted in `model.counters`.
        """
        last_us = int(events["t"][-1]) if len(events) else self._t_us
        self._t_us = max(self._t_us, last_us if until_us is None else until_us)
        self.bus.call(self._show, events)

    def _show(self, events: Events) -> None:
        self.model.offer(events)
        self.model.advance(self._t_us)
