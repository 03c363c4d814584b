"""Device on this machine's USB bus, real or emulated, through libusb (pyusb).

pyusb is synchronous, so a thread keeps one bulk read in progress while the caller processes the earlier data. Between
two reads the camera cannot send; it buffers or drops data, and counts the dropped data.
"""

from __future__ import annotations

import errno
import queue
import threading
from collections.abc import Iterator
from contextlib import contextmanager

import usb.backend
import usb.core
import usb.util

from firmware_protocol.usb.descriptors import Speed
from firmware_protocol.usb.device import Identity, SetupPacket
from transports.usb.host import (
    AccessDenied,
    DeviceAbsent,
    DeviceBusy,
    LibraryMissing,
    PeerGone,
    StallError,
    TransferTimeout,
    UsbHostError,
)

UDEV_RULE = 'SUBSYSTEM=="usb", ATTR{idVendor}=="152a|04b4|31f7|1409", MODE="0666"'
"""Rule that permits every user to open the devices of iniVation, of the EVK4's USB chip, CenturyArks and IDS."""

_LIBUSB_MISSING = "libusb 1.0 is missing: apt-get install libusb-1.0-0"
_DENIED = (
    "this user may not open the camera: put the line\n"
    f"  {UDEV_RULE}\n"
    "into /etc/udev/rules.d/65-event-camera.rules, then run: udevadm control --reload && udevadm trigger"
)
_POLL_S = 0.1


class PyusbHost:
    """Device opened with libusb: a `device` of pyusb; `timeout_s`: timeout of a control request."""

    def __init__(self, device: usb.core.Device, timeout_s: float = 1.0) -> None:
        self._device = device
        self._timeout_ms = round(1000 * timeout_s)
        self._readers: list[PyusbReader] = []

    @classmethod
    def find(
        cls, vendor_id: int, product_id: int, backend: usb.backend.IBackend | None = None, timeout_s: float = 1.0
    ) -> PyusbHost:
        """Find the first device with these numbers. Raises LibraryMissing without libusb, DeviceAbsent without it."""
        try:
            device = usb.core.find(idVendor=vendor_id, idProduct=product_id, backend=backend)
        except usb.core.NoBackendError as error:
            raise LibraryMissing(_LIBUSB_MISSING) from error
        if device is None:
            raise DeviceAbsent(
                f"no device {vendor_id:04x}:{product_id:04x} on this machine's USB bus: plug the camera in, "
                "or attach an emulated one (usbip attach -r HOST -b 1-1)"
            )
        return cls(device, timeout_s)

    @property
    def identity(self) -> Identity:
        """Identity in the device's descriptor."""
        d = self._device
        speed = Speed(d.speed) if d.speed in (1, 2, 3) else Speed.SUPER
        classes = (d.bDeviceClass, d.bDeviceSubClass, d.bDeviceProtocol)
        return Identity(d.idVendor, d.idProduct, d.bcdDevice, speed, classes, configurations=d.bNumConfigurations)

    def configure(self) -> None:
        """Select configuration 1 unless it is active already, and claim interface 0."""
        with _errors("opening the camera"):
            if self._active_configuration() != 1:
                self._device.set_configuration(1)
            usb.util.claim_interface(self._device, 0)

    def clear_halt(self, endpoint: int) -> None:
        """Clear the halt of an IN endpoint, here and in the device."""
        with _errors(f"endpoint {endpoint}"):
            self._device.clear_halt(0x80 | endpoint)

    def control_in(self, setup: SetupPacket) -> bytes:
        """Request at most `setup.length` bytes from the device."""
        return bytes(self._control(setup, setup.length))

    def control_out(self, setup: SetupPacket, data: bytes = b"") -> int:
        """Send `data` with a control request; return the number of bytes that the device took."""
        return int(self._control(setup, data))

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send `data` to an OUT endpoint."""
        with _errors(f"endpoint {endpoint}"):
            self._device.write(endpoint, data, self._timeout_ms)

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Read one transfer of at most `length` bytes from an IN endpoint."""
        with _errors(f"endpoint {endpoint}"):
            return bytes(self._device.read(0x80 | endpoint, length, self._timeout_ms))

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> PyusbReader:
        """Start reading an IN endpoint; up to `transfers` transfers are queued for a slow caller."""
        reader = PyusbReader(self._device, endpoint, transfer_bytes, transfers)
        self._readers.append(reader)
        return reader

    def close(self) -> None:
        """Stop reading and close the device."""
        for reader in self._readers:
            reader.close()
        usb.util.dispose_resources(self._device)

    def _active_configuration(self) -> int:
        try:
            return int(self._device.get_active_configuration().bConfigurationValue)
        except usb.core.USBError as error:
            if error.errno in (errno.EACCES, errno.ENODEV):
                raise
            return 0  # not configured yet

    def _control(self, setup: SetupPacket, data_or_length: bytes | int) -> bytes:
        with _errors(str(setup)):
            result: bytes = self._device.ctrl_transfer(
                setup.request_type, setup.request, setup.value, setup.index, data_or_length, self._timeout_ms
            )
        return result


class PyusbReader:
    """Thread that reads one IN endpoint into a bounded queue."""

    def __init__(self, device: usb.core.Device, endpoint: int, transfer_bytes: int, depth: int) -> None:
        self._device = device
        self._address = 0x80 | endpoint
        self._transfer_bytes = transfer_bytes
        self._arrived: queue.Queue[bytes | usb.core.USBError] = queue.Queue(depth)
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name=f"usb endpoint {endpoint}", daemon=True)
        self._thread.start()

    def read(self, timeout_s: float) -> bytes | None:
        """Return the next transfer's data; None when none came in time. PeerGone: device lost, StallError: halted."""
        try:
            item = self._arrived.get(timeout=timeout_s)
        except queue.Empty:
            return None
        if isinstance(item, usb.core.USBError):
            with _errors("reading the stream"):
                raise item
        return item

    def close(self) -> list[bytes]:
        """Stop reading; return the transfers that had arrived unread."""
        self._stop.set()
        remaining: list[bytes | usb.core.USBError] = []
        while self._thread.is_alive() or not self._arrived.empty():
            # The thread may be waiting for room in the queue.
            try:
                remaining.append(self._arrived.get(timeout=_POLL_S))
            except queue.Empty:
                continue
        return [item for item in remaining if isinstance(item, bytes)]

    def _run(self) -> None:
        while not self._stop.is_set():
            try:
                data = self._device.read(self._address, self._transfer_bytes, round(1000 * _POLL_S))
            except usb.core.USBTimeoutError:
                continue  # libusb returns the data received before a timeout, so nothing is lost here
            except usb.core.USBError as error:
                self._arrived.put(error)
                return
            self._arrived.put(bytes(data))


@contextmanager
def _errors(attempt: str) -> Iterator[None]:
    """Turn an error of libusb into the project's own."""
    try:
        yield
    except usb.core.USBError as error:
        match error.errno:
            case errno.EACCES:
                raise AccessDenied(_DENIED) from error
            case errno.EBUSY:
                raise DeviceBusy("another program has the camera open; close it first") from error
            case errno.ENODEV | errno.EIO:
                raise PeerGone(f"{attempt}: the camera went away") from error
            case errno.EPIPE:
                raise StallError(f"{attempt}: the device refused (STALL)") from error
            case errno.ETIMEDOUT:
                raise TransferTimeout(f"{attempt}: no answer in time") from error
        raise UsbHostError(f"{attempt}: {error}") from error
