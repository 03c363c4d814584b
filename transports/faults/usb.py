"""What faults do to a device on USB, between it and its host. Sans-I/O."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from firmware_protocol.usb.control import Feature, Recipient, StandardRequest
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Stall, Transfer, UsbDevice
from transports.faults.kinds import Fault
from transports.faults.script import FaultPlan, FaultRecord, Faults
from transports.faults.usb_kinds import ShortTransfers, UsbSilence, UsbStall, UsbUnplugged

__all__ = ["FaultyDevice", "UsbStage"]


@dataclass
class UsbStage:
    """One fault at work on one IN endpoint, or on the whole device when it is `gone`."""

    endpoint: int = 0
    silent: bool = False
    stalls: int = 0
    most_bytes: int = 0
    gone: bool = False
    hits: int = 0
    touched: int = 0
    over: bool = False


class FaultyDevice(UsbDevice):
    """Passes everything on to a device, by way of the faults."""

    def __init__(self, device: UsbDevice, plan: FaultPlan) -> None:
        self._device = device
        self._faults: Faults[UsbStage] = Faults(plan, usb_stage)
        self._halted: set[int] = set()

    @property
    def records(self) -> tuple[FaultRecord, ...]:
        """What each fault has done."""
        return self._faults.records

    @property
    def gone(self) -> bool:
        """True while the device is unplugged."""
        return any(stage.gone for stage in self._faults.stages)

    def advance(self, now_us: int) -> None:
        """Let stream time pass."""
        self._faults.advance(now_us)

    def inject(self, fault: Fault) -> None:
        """Begin a fault now; raises ValueError for one that USB does not have."""
        self._faults.inject(fault)

    def close(self) -> None:
        """End them all."""
        self._faults.close()

    @property
    def identity(self) -> Identity:
        """The device's own."""
        return self._device.identity

    def attached(self) -> None:
        """See `UsbDevice.attached`; nothing is halted then."""
        self._halted.clear()
        self._device.attached()

    def detached(self) -> None:
        """Pass on."""
        self._device.detached()

    def control(self, setup: SetupPacket, data: bytes) -> bytes:
        """Pass on; the host may end a halt."""
        answer = self._device.control(setup, data)
        if _ends_halt(setup):
            self._halted.discard(setup.index & 0x0F)
        return answer

    def read(self, endpoint: int, max_bytes: int) -> Transfer | None:
        """See `UsbDevice.read`."""
        for stage in [stage for stage in self._faults.stages if stage.endpoint == endpoint]:
            if stage.stalls and endpoint not in self._halted:
                self._halted.add(endpoint)
                stage.stalls -= 1
                stage.over = not stage.stalls
                self._strike(stage)
            if stage.silent:
                self._strike(stage)
                return None
            if stage.most_bytes and max_bytes > stage.most_bytes:
                self._strike(stage)
                max_bytes = stage.most_bytes
        if endpoint in self._halted:
            raise Stall(f"endpoint {endpoint} is halted, by a fault")
        return self._device.read(endpoint, max_bytes)

    def write(self, endpoint: int, data: bytes) -> None:
        """Pass on."""
        self._device.write(endpoint, data)

    def sent(self, transfer: Transfer) -> None:
        """Pass on."""
        self._device.sent(transfer)

    def lost(self, transfer: Transfer) -> None:
        """Pass on."""
        self._device.lost(transfer)

    def _strike(self, stage: UsbStage) -> None:
        stage.hits += 1
        self._faults.struck(stage, [stage.hits] if stage.hits == 1 else [])


def usb_stage(fault: Fault, random: np.random.Generator) -> UsbStage:
    """Return what this fault does to a device on USB; raises ValueError for one that USB does not have."""
    match fault:
        case UsbSilence():
            return UsbStage(fault.endpoint, silent=True)
        case UsbStall():
            return UsbStage(fault.endpoint, stalls=fault.count)
        case ShortTransfers():
            return UsbStage(fault.endpoint, most_bytes=fault.most_bytes)
        case UsbUnplugged():
            return UsbStage(gone=True, hits=1)
    raise ValueError(f"{fault.kind!r} is no fault of a USB link")


def _ends_halt(setup: SetupPacket) -> bool:
    return (
        setup.kind is RequestKind.STANDARD
        and setup.recipient == Recipient.ENDPOINT
        and setup.request == StandardRequest.CLEAR_FEATURE
        and setup.value == Feature.ENDPOINT_HALT
    )
