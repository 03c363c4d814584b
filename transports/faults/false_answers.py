"""Answers of a camera on USB that faults have changed: who it is, its versions, and bits of its registers.

GET_DESCRIPTOR device     bytes 12, 13: bcdDevice; its low byte is the firmware version
GET_DESCRIPTOR string 3   the serial number: length, type 3, UTF-16
0xBF IN, 4 bytes          a register of a DAVIS346, big-endian; see `davis346.device`
"""

from __future__ import annotations

from dataclasses import replace

from firmware_protocol.davis346.device import REGISTER
from firmware_protocol.davis346.registers import Module
from firmware_protocol.usb.control import StandardRequest
from firmware_protocol.usb.device import Identity, RequestKind, SetupPacket, Stall, UsbDevice
from transports.faults.davis_kinds import RegisterFlip, WrongVersion

__all__ = ["FalseAnswers", "flip_register"]

_DEVICE, _SERIAL = 0x0100, 0x0303
_STRING_TYPE = 3
_OUT, _IN = 0x40, 0xC0
_Address = tuple[int, int]
_LOGIC, _CHIP, _PATCH = (Module.SYSTEM, 0), (Module.SYSTEM, 1), (Module.SYSTEM, 7)


class FalseAnswers:
    """What the camera says in place of the truth.

    Attributes
    ----------
    serial
        Its serial number; empty: its own.
    versions
        The faults that change its versions; the last one counts.
    """

    def __init__(self) -> None:
        self.serial = ""
        self.versions: list[WrongVersion] = []
        self._flipped: dict[_Address, int] = {}

    def power_on(self) -> None:
        """Forget the flips of registers."""
        self._flipped.clear()

    def flip(self, address: _Address, bit: int) -> None:
        """Let a register that nobody can write read with one bit turned over."""
        self._flipped[address] = self._flipped.get(address, 0) ^ 1 << bit

    def identity(self, true: Identity) -> Identity:
        """Return what a host's bus lists."""
        return replace(true, bcd_device=self._firmware(true.bcd_device))

    def answer(self, setup: SetupPacket, true: bytes) -> bytes:
        """Return what a host gets for the answer to one IN request."""
        if setup.kind is RequestKind.STANDARD and setup.request == StandardRequest.GET_DESCRIPTOR:
            return self._descriptor(setup, true)
        if setup.kind is RequestKind.VENDOR and setup.request == REGISTER and len(true) == 4:
            address = setup.value, setup.index
            value = self._version(address, int.from_bytes(true, "big")) ^ self._flipped.get(address, 0)
            return value.to_bytes(4, "big")
        return true

    def _descriptor(self, setup: SetupPacket, true: bytes) -> bytes:
        if setup.value == _DEVICE and len(true) >= 14:
            firmware = self._firmware(int.from_bytes(true[12:14], "little"))
            return true[:12] + firmware.to_bytes(2, "little") + true[14:]
        if setup.value == _SERIAL and self.serial:
            text = self.serial.encode("utf-16-le")
            return (bytes((len(text) + 2, _STRING_TYPE)) + text)[: setup.length]
        return true

    def _firmware(self, true: int) -> int:
        told = [one.firmware for one in self.versions if one.firmware >= 0]
        return true & 0xFF00 | told[-1] if told else true

    def _version(self, address: _Address, true: int) -> int:
        values = {_LOGIC: "logic_version", _CHIP: "chip", _PATCH: "logic_patch"}
        name = values.get((Module(address[0]), address[1])) if address[0] == Module.SYSTEM else None
        told = [getattr(one, name) for one in self.versions if getattr(one, name) >= 0] if name else []
        return told[-1] if told else true


def flip_register(device: UsbDevice, false: FalseAnswers, flip: RegisterFlip) -> bool:
    """Turn over one bit of a register of `device`; False where it has no such register requests."""
    ask = SetupPacket(_IN, REGISTER, flip.module, flip.parameter, 4)
    tell = SetupPacket(_OUT, REGISTER, flip.module, flip.parameter, 4)
    try:
        value = int.from_bytes(device.control(ask, b""), "big") ^ 1 << flip.bit
        device.control(tell, value.to_bytes(4, "big"))
        if int.from_bytes(device.control(ask, b""), "big") != value:
            false.flip((flip.module, flip.parameter), flip.bit)
    except Stall:
        return False
    return True
