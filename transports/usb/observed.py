"""A USB device whose deliveries are noted, without its knowing."""

from __future__ import annotations

from firmware_protocol.usb.device import Identity, SetupPacket, Transfer, UsbDevice
from transports.link.deliveries import Deliveries

__all__ = ["Observed"]


class Observed(UsbDevice):
    """Passes everything on to a device, and to `deliveries` what was sent."""

    def __init__(self, device: UsbDevice, deliveries: Deliveries) -> None:
        self._device = device
        self._deliveries = deliveries

    @property
    def identity(self) -> Identity:
        """The device's own."""
        return self._device.identity

    def attached(self) -> None:
        """Pass on."""
        self._device.attached()

    def detached(self) -> None:
        """Pass on."""
        self._device.detached()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Pass on."""
        return self._device.control(setup, data)

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """Pass on."""
        return self._device.read(endpoint, max_bytes)

    def accepts(self, setup: SetupPacket) -> bool:
        """Pass on."""
        return self._device.accepts(setup)

    def flushes(self, endpoint: int) -> int:
        """Pass on."""
        return self._device.flushes(endpoint)

    def write(self, endpoint: int, data: bytes) -> None:
        """Pass on."""
        self._device.write(endpoint, data)

    def sent(self, transfer: Transfer) -> None:
        """Note what left, and pass on."""
        self._deliveries.add(transfer.events, transfer.epoch_us, transfer.edges, transfer.readings)
        self._device.sent(transfer)

    def lost(self, transfer: Transfer) -> None:
        """Pass on."""
        self._device.lost(transfer)
