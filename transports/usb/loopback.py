"""Loopback of a USB camera: a host and its camera in one process, with the real device model and real decoder.

`DirectHost` is a `UsbHost` whose cable is a function call. `LoopbackEndpoint` drives a camera through it as a driver
does, and compares every decoded event and frame with those that the camera sent.

Not modelled: time on a wire, packets, other traffic, a slow or lost host. Transfers are never lost and have no latency.
"""

from __future__ import annotations

from typing import Any

import numpy as np

from firmware_protocol.device.items import ReadingKind
from firmware_protocol.events import Edges, Events
from firmware_protocol.frames import FrameAssembler
from firmware_protocol.fx3.decoded import FrameRead
from firmware_protocol.imu_samples import ImuSamples, no_samples
from firmware_protocol.usb.device import NotReady, SetupPacket, Stall, Transfer, UsbCamera, UsbDevice
from transports.faults.faulty_device import FaultyDevice
from transports.faults.script import FaultPlan
from transports.link.deliveries import Deliveries
from transports.link.endpoint import REST_NS, Endpoint, LinkBroken
from transports.link.kind import Wiring
from transports.usb.host import CameraHost, StallError, StreamSettings, TransferTimeout
from transports.usb.kind import LoopbackLink


class DirectReader:
    """Reader of one IN endpoint by direct calls; returns None where a real host would wait."""

    def __init__(self, device: UsbDevice, endpoint: int, transfer_bytes: int) -> None:
        self._device = device
        self._endpoint = endpoint
        self._transfer_bytes = transfer_bytes
        self.last: Transfer | None = None

    def read(self, timeout_s: float) -> bytes | None:
        """Return the data that the device has now, for any `timeout_s`; raises StallError."""
        try:
            self.last = self._device.read(self._endpoint, self._transfer_bytes)
        except Stall as stall:
            raise StallError(f"endpoint {self._endpoint} is halted") from stall
        if self.last is None:
            return None
        self._device.sent(self.last)
        return self.last.data

    def close(self) -> list[bytes]:
        """Return no transfer, because none is ever pending."""
        return []


class DirectHost:
    """A `UsbHost` that calls its device directly."""

    def __init__(self, device: UsbDevice) -> None:
        self._device = device
        self.identity = device.identity
        self._is_open = True
        self.reader: DirectReader | None = None
        device.attached()

    def configure(self) -> None:
        """Select configuration 1."""
        self.control_out(SetupPacket(0x00, 9, 1, 0, 0))

    def clear_halt(self, endpoint: int) -> None:
        """Clear the halt of an IN endpoint."""
        self.control_out(SetupPacket(0x02, 1, 0, 0x80 | endpoint, 0))

    def control_in(self, setup: SetupPacket) -> bytes:
        """Send an IN request to the device; raises StallError."""
        return self._control(setup, b"")

    def control_out(self, setup: SetupPacket, data: bytes = b"") -> int:
        """Send an OUT request to the device; raises StallError."""
        self._control(setup, data)
        return len(data)

    def _control(self, setup: SetupPacket, data: bytes) -> bytes:
        try:
            return self._device.control(setup, data)
        except Stall as stall:
            raise StallError(f"the device refused {setup}") from stall
        except NotReady as late:
            raise TransferTimeout(f"{setup}: no answer now, and nothing here waits") from late

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send data to the device; raises StallError."""
        try:
            self._device.write(endpoint, data)
        except Stall as stall:
            raise StallError(f"endpoint {endpoint}: the device refused {len(data)} bytes") from stall

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Read the data that the device has now; raises StallError, and TransferTimeout if it has none."""
        data = DirectReader(self._device, endpoint, length).read(0.0)
        if data is None:
            raise TransferTimeout(f"endpoint {endpoint}: the device has no data")
        return data

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> DirectReader:
        """Read an IN endpoint; no transfers are queued."""
        self.reader = DirectReader(self._device, endpoint, transfer_bytes)
        return self.reader

    def close(self) -> None:
        """Release the device."""
        if self._is_open:
            self._is_open = False
            self._device.detached()


class LoopbackEndpoint(Endpoint):
    """Driver that reads a camera as soon as it has data, and compares the data with those sent."""

    longest_sleep_ns = REST_NS  # nothing but new data has an effect

    def __init__(self, link: LoopbackLink, wiring: Wiring, device: UsbCamera, deliveries: Deliveries) -> None:
        self._device = FaultyDevice(device, FaultPlan(), deliveries.add)
        self._host: DirectHost | None = None
        self._camera: CameraHost[Any] | None = None
        self._received = self._edges = self._frames = self._samples = 0
        self._assembler = FrameAssembler()

    async def start(self) -> None:
        """Open the camera, identify it, start it and reset its clock."""
        from transports.usb.cameras import driver_of  # the drivers of all cameras: the session needs the factory alone

        self._host = DirectHost(self._device)
        self._camera = driver_of(self._host)
        self._camera.start(StreamSettings(edges=True, frames=True, imu=True))

    def pump(self) -> None:
        """Read all data of the camera; raises LinkBroken when an event differs from the one sent."""
        while self._camera is not None and self._host is not None:
            received = self._camera.read(0.0)
            if received is None:
                return
            edges = self._camera.take_edges()
            self._received += len(received)
            imu = self._camera.take_imu()
            self._edges += len(edges)
            self._samples += len(imu)
            transfer = (self._host.reader and self._host.reader.last) or Transfer()
            _compare(received, edges, imu, transfer)
            self._compare_frames(self._camera.take_frames(), transfer)

    def _compare_frames(self, received: list[FrameRead], transfer: Transfer) -> None:
        sent = self._assembler.add(transfer.readings)
        same = [
            frame.start_us == other.start_us - transfer.epoch_us
            and np.array_equal(frame.reset, other.reset)
            and np.array_equal(frame.signal, other.signal)
            for frame, other in zip(received, sent, strict=False)
        ]
        if len(received) != len(sent) or not all(same):
            raise LinkBroken(f"loopback: {len(sent)} frames were sent and {len(received)} others received")
        self._frames += len(received)

    async def close(self) -> None:
        """Stop the camera and release it."""
        if self._camera is not None:
            self._camera.close()

    @property
    def state(self) -> str:
        """Counts of the compared data."""
        edges = f", {self._edges} edges" if self._edges else ""
        frames = f", {self._frames} frames" if self._frames else ""
        samples = f", {self._samples} IMU samples" if self._samples else ""
        return f"{self._received} events{edges}{frames}{samples} checked"


def _compare(received: Events, edges: Edges, imu: ImuSamples, transfer: Transfer) -> None:
    records = (reading.record for reading in transfer.readings if reading.kind is ReadingKind.IMU)
    sent_imu = np.concatenate([no_samples(), *records])
    pairs = (("events", received, transfer.events), ("edges", edges, transfer.edges), ("samples", imu, sent_imu))
    for kind, got, expected in pairs:
        sent = expected.copy()
        sent["t"] -= np.uint64(transfer.epoch_us)
        if not np.array_equal(got, sent):
            raise LinkBroken(f"loopback: {len(sent)} {kind} were sent and {len(got)} others received")
