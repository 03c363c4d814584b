"""The host's side of a USB cable, as a driver sees it, and what can go wrong there.

UsbHostError
StallError        the device refused a request
TransferTimeout   the device did not answer in time
DeviceAbsent      no such device: plug it in, or start the emulator
DeviceBusy        another driver or host holds the device
AccessDenied      this user may not open the device (a udev rule is missing)
LibraryMissing    the machine lacks libusb
PeerGone          the device or its server went away
PeerBroken        the device or its server answers nonsense
"""

from __future__ import annotations

from typing import Protocol

from firmware_protocol.usb.device import Identity, SetupPacket

__all__ = [
    "AccessDenied",
    "BulkReader",
    "DeviceAbsent",
    "DeviceBusy",
    "LibraryMissing",
    "PeerBroken",
    "PeerGone",
    "StallError",
    "TransferTimeout",
    "UnsuitableDevice",
    "UsbHost",
    "UsbHostError",
]


class UsbHostError(Exception):
    """Something went wrong between a driver and its device."""


class StallError(UsbHostError):
    """The device refused a request."""


class TransferTimeout(UsbHostError):
    """The device did not answer in time."""


class DeviceAbsent(UsbHostError):
    """There is no such device."""


class DeviceBusy(UsbHostError):
    """Another driver or host holds the device."""


class UnsuitableDevice(UsbHostError):
    """The device is not one that this driver can use."""


class AccessDenied(UsbHostError):
    """The user may not open the device."""


class LibraryMissing(UsbHostError):
    """The machine lacks a library."""


class PeerGone(UsbHostError):
    """The device, or the server that offers it, went away."""


class PeerBroken(UsbHostError):
    """The device, or the server that offers it, breaks the protocol."""


class BulkReader(Protocol):
    """A stream of data from one IN endpoint, in order."""

    def read(self, timeout_s: float) -> bytes | None:
        """Return the next transfer's data; None when none came in time."""

    def close(self) -> list[bytes]:
        """Take back what is pending; gives the transfers that had arrived unread, so that nothing is lost."""


class UsbHost(Protocol):
    """A device in the hands of a driver."""

    @property
    def identity(self) -> Identity:
        """Vendor, product and version of the device."""

    def configure(self) -> None:
        """Select the device's configuration and claim its interface, as an operating system and a driver do."""

    def clear_halt(self, endpoint: int) -> None:
        """Reset an IN endpoint (number without the direction bit) after a STALL, or before a new stream."""

    def control_in(self, setup: SetupPacket) -> bytes:
        """Ask for at most `setup.length` bytes. Raises StallError, TransferTimeout, PeerGone."""

    def control_out(self, setup: SetupPacket, data: bytes = b"") -> int:
        """Send `data`; gives the number of bytes the device took. Raises StallError, TransferTimeout, PeerGone."""

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send `data` to an OUT endpoint. Raises StallError, TransferTimeout, PeerGone."""

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Take one transfer of at most `length` bytes from an IN endpoint that no `stream` reads. Raises the same."""

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> BulkReader:
        """Read an IN endpoint (number without the direction bit) with several transfers in flight."""

    def close(self) -> None:
        """Let go of the device; a second call does nothing."""
