"""Host side of a USB cable, as a driver uses it, and its errors.

UsbHostError
StallError        the device refused a request
TransferTimeout   the device did not answer in time
DeviceAbsent      no such device: plug it in, or start the emulator
DeviceBusy        another driver or host holds the device
AccessDenied      this user may not open the device (a udev rule is missing)
LibraryMissing    the machine lacks libusb
PeerGone          the device or its server was lost
PeerBroken        the device or its server sends invalid answers
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
    """Error between a driver and its device."""


class StallError(UsbHostError):
    """Error: the device refused a request."""


class TransferTimeout(UsbHostError):
    """Error: the device did not answer in time."""


class DeviceAbsent(UsbHostError):
    """Error: there is no such device."""


class DeviceBusy(UsbHostError):
    """Error: another driver or host holds the device."""


class UnsuitableDevice(UsbHostError):
    """Error: this driver cannot use the device."""


class AccessDenied(UsbHostError):
    """Error: the user may not open the device."""


class LibraryMissing(UsbHostError):
    """Error: the machine lacks a library."""


class PeerGone(UsbHostError):
    """Error: the device, or the server that offers it, was lost."""


class PeerBroken(UsbHostError):
    """Error: the device, or the server that offers it, breaks the protocol."""


class BulkReader(Protocol):
    """Stream of data from one IN endpoint, in order."""

    def read(self, timeout_s: float) -> bytes | None:
        """Return the next transfer's data; None when none arrived in time."""

    def close(self) -> list[bytes]:
        """Cancel the pending transfers; return the data of those that had arrived unread, so that nothing is lost."""


class UsbHost(Protocol):
    """Device that a driver has opened."""

    @property
    def identity(self) -> Identity:
        """Vendor, product and version of the device."""

    def configure(self) -> None:
        """Select the device's configuration and claim its interface, as an operating system and a driver do."""

    def clear_halt(self, endpoint: int) -> None:
        """Reset an IN endpoint (number without the direction bit) after a STALL, or before a new stream."""

    def control_in(self, setup: SetupPacket) -> bytes:
        """Request at most `setup.length` bytes. Raises StallError, TransferTimeout, PeerGone."""

    def control_out(self, setup: SetupPacket, data: bytes = b"") -> int:
        """Send `data`; return the number of bytes that the device took.

        Raises StallError, TransferTimeout, PeerGone.
        """

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send `data` to an OUT endpoint. Raises StallError, TransferTimeout, PeerGone."""

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Read one transfer of at most `length` bytes from an IN endpoint that no `stream` reads.

        Raises the same errors.
        """

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> BulkReader:
        """Read an IN endpoint (number without the direction bit) with several transfers in flight."""

    def close(self) -> None:
        """Close the device; a second call does nothing."""
