"""Host side of a USB cable, as a driver uses it, its errors, and the common part of all drivers of cameras."""

from __future__ import annotations

from abc import ABC, abstractmethod
from contextlib import suppress
from dataclasses import dataclass
from typing import TYPE_CHECKING, Generic, Protocol, TypeVar

import numpy as np

from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.imu_samples import ImuSamples, no_samples
from firmware_protocol.usb.device import Identity, SetupPacket

if TYPE_CHECKING:
    from firmware_protocol.fx3.decoded import FrameRead, WordFaults


class UsbHostError(Exception):
    """Error between a driver and its device."""


class StallError(UsbHostError):
    """Error: the device refused a request."""


class TransferTimeout(UsbHostError):
    """Error: the device did not answer in time."""


class DeviceAbsent(UsbHostError):
    """Error: there is no such device: plug it in, or start the emulator."""


class DeviceBusy(UsbHostError):
    """Error: another driver or host holds the device."""


class UnsuitableDevice(UsbHostError):
    """Error: this driver cannot use the device."""


class AccessDenied(UsbHostError):
    """Error: the user may not open the device: a udev rule is missing."""


class LibraryMissing(UsbHostError):
    """Error: the machine lacks libusb."""


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
        """Send `data`; return the number of bytes taken. Raises StallError, TransferTimeout, PeerGone."""

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send `data` to an OUT endpoint. Raises StallError, TransferTimeout, PeerGone."""

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Read a transfer, at most `length` bytes, of an IN endpoint that no `stream` reads; raises the same errors."""

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> BulkReader:
        """Read an IN endpoint (number without the direction bit) with several transfers in flight."""

    def close(self) -> None:
        """Close the device; a second call does nothing."""


@dataclass(frozen=True)
class StreamSettings:
    """Settings of a stream.

    Attributes
    ----------
    transfer_bytes, transfers
        Size and number of the bulk transfers in flight: neuromorphic_drivers has 32 of 131072, libcaer 8 of 8192.
    reset_timestamps : Set the camera's clock to zero after the start and wait for it, as dv-processing does; without it
        events have the time since the start of the camera's clock.
    early_packet_us : time after which a buffer that is not full leaves the camera; libcaer's default is 1 ms.
    edges : enable rising edges, falling edges and pulses of the external input; see `CameraHost.take_edges`.
    imu : enable the inertial unit, if there is one; see `CameraHost.take_imu`.
    frames : enable the APS, with its current registers; see `CameraHost.take_frames`.
    """

    transfer_bytes: int = 131_072
    transfers: int = 32
    reset_timestamps: bool = True
    early_packet_us: int = 1000
    edges: bool = False
    imu: bool = False
    frames: bool = False


_Info = TypeVar("_Info")


class CameraHost(ABC, Generic[_Info]):
    """Driver of one event camera: identify it, start it, read its events, stop it.

    `model`: name of the camera's model; `info`: identity that the camera reports.
    """

    model: str

    def __init__(self, host: UsbHost) -> None:
        self._host = host
        self._reader: BulkReader | None = None
        self._edges: list[Edges] = []
        try:
            host.configure()
            self.info = self._identify()
        except UsbHostError:
            host.close()
            raise

    @property
    @abstractmethod
    def faults(self) -> WordFaults:
        """Counts of words that an intact stream never contains."""

    @abstractmethod
    def start(self, settings: StreamSettings | None = None) -> None:
        """Start the stream of events."""

    def read(self, timeout_s: float) -> Events | None:
        """Return the next transfer's events, in device time, none if it has times only; None when none came in time."""
        data = self.read_words(timeout_s)
        return None if data is None else self._decode(data)

    def read_words(self, timeout_s: float) -> bytes | None:
        """Return the next transfer's words as they are; None when none came in time."""
        if self._reader is None:
            raise RuntimeError("the camera is not started")
        return self._reader.read(timeout_s)

    def take_edges(self) -> Edges:
        """Return the edges read since the last call, (n,) EDGE in device time, if the start enabled them."""
        edges, self._edges = self._edges, []
        return np.concatenate([empty_edges(), *edges])

    def take_frames(self) -> list[FrameRead]:
        """Return the frames read since the last call, if the camera has any and the start enabled them."""
        return []

    def take_imu(self) -> ImuSamples:
        """Return the samples of its inertial unit since the last call, (n,) IMU_SAMPLE in device time, likewise."""
        return no_samples()

    def stop(self) -> Events:
        """Stop the camera and the stream; return the events that were still in transit."""
        return np.concatenate([empty_events(), *map(self._decode, self.stop_words())])

    def stop_words(self) -> list[bytes]:
        """Stop the camera and the stream; return the transfers that were still in transit."""
        self._end_stream()
        reader, self._reader = self._reader, None
        return reader.close() if reader else []

    def close(self) -> None:
        """Stop the camera, if it is still there, and close it."""
        with suppress(UsbHostError):
            self.stop()
        self._host.close()

    @abstractmethod
    def _identify(self) -> _Info:
        """Return the camera's identity; raises UnsuitableDevice."""

    @abstractmethod
    def _decode(self, data: bytes) -> Events:
        """Return the events in the data of a transfer, and store what else is in them."""

    @abstractmethod
    def _end_stream(self) -> None:
        """Request the end of the stream."""
