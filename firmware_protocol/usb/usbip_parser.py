"""Bytes of a USB/IP connection -> messages, for either end, however the bytes were cut on the way.

The layouts are drawn in `firmware_protocol.usb.usbip`. A parser is fed with `receive` and asked with `next_message`
until that gives None. It keeps no more than one unfinished message beyond what it was fed.
"""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.usb import usbip
from firmware_protocol.usb.usbip import (
    DeviceListReply,
    DeviceListRequest,
    DeviceRecord,
    ImportReply,
    ImportRequest,
    OpStatus,
    Submit,
    Submitted,
    Unlink,
    Unlinked,
    UsbipError,
)

__all__ = ["HostParser", "Limits", "Reply", "Request", "ServerParser"]

Request = DeviceListRequest | ImportRequest | Submit | Unlink
Reply = DeviceListReply | ImportReply | Submitted | Unlinked


@dataclass(frozen=True)
class Limits:
    """What a peer may ask for before it counts as broken.

    Attributes
    ----------
    in_bytes
        Longest IN transfer. 16 MiB is all that Linux lets one usbfs user have in flight by default.
    out_bytes
        Longest OUT transfer, since it is held in memory until it is complete. A control transfer has 65535 at most.
    devices
        Most devices a server may list; Linux has 8 controllers of 30 ports.
    """

    in_bytes: int = 16 << 20
    out_bytes: int = 1 << 20
    devices: int = 240


class ServerParser:
    """The device's end: operations first, URBs after `begin_urbs`."""

    def __init__(self, limits: Limits = Limits()) -> None:
        self._limits = limits
        self._buffer = bytearray()
        self._urbs = False

    def receive(self, data: bytes | memoryview) -> None:
        """Take bytes as they came."""
        self._buffer += data

    def begin_urbs(self) -> None:
        """Say that an import was granted: what follows are URBs."""
        self._urbs = True

    def next_message(self) -> Request | None:
        """Return the next complete message, None when more bytes are needed; raises UsbipError on a broken one."""
        return self._next_urb() if self._urbs else self._next_operation()

    def _next_operation(self) -> DeviceListRequest | ImportRequest | None:
        head = usbip.OP_HEADER.size
        if len(self._buffer) < head:
            return None
        code, _ = _operation(self._buffer)
        if code == usbip.REQ_DEVLIST:
            del self._buffer[:head]
            return DeviceListRequest()
        if code != usbip.REQ_IMPORT:
            raise UsbipError(f"unknown operation 0x{code:04x}; known are 0x8005 (device list) and 0x8003 (import)")
        end = head + usbip.BUSID_BYTES
        if len(self._buffer) < end:
            return None
        request = ImportRequest.parse(_cut(self._buffer, head, end))
        del self._buffer[:end]
        return request

    def _next_urb(self) -> Submit | Unlink | None:
        if len(self._buffer) < usbip.URB_HEADER_BYTES:
            return None
        command, seqnum, devid, direction, endpoint, *rest = usbip.SUBMIT.unpack_from(self._buffer)
        if command == usbip.CMD_UNLINK:
            del self._buffer[: usbip.URB_HEADER_BYTES]
            return Unlink(seqnum, devid, rest[0])
        if command != usbip.CMD_SUBMIT:
            raise UsbipError(f"unknown URB command 0x{command:08x}; known are 1 (submit) and 2 (unlink)")
        flags, length, _, packets, interval, setup = rest
        self._check_submit(direction, endpoint, length, packets)
        end = usbip.URB_HEADER_BYTES + (0 if direction else length)
        if len(self._buffer) < end:
            return None
        data = _cut(self._buffer, usbip.URB_HEADER_BYTES, end)
        del self._buffer[:end]
        return Submit(seqnum, devid, bool(direction), endpoint, length, setup, data, flags, interval)

    def _check_submit(self, direction: int, endpoint: int, length: int, packets: int) -> None:
        if direction > 1:
            raise UsbipError(f"a URB has direction 0 (OUT) or 1 (IN), got {direction}")
        if endpoint > 15:
            raise UsbipError(f"endpoint numbers go from 0 to 15, got {endpoint}")
        if packets not in (0, -1):
            raise UsbipError(f"isochronous transfers are not served, got one of {packets} packets")
        _check_length(length, self._limits.in_bytes if direction else self._limits.out_bytes)


class HostParser:
    """The host's end: replies to operations first, URB replies after `begin_urbs`.

    The layout of a RET_SUBMIT depends on the direction of its URB, which the reply does not say: call `expect` for each
    URB that goes out.
    """

    def __init__(self, limits: Limits = Limits()) -> None:
        self._limits = limits
        self._buffer = bytearray()
        self._urbs = False
        self._lengths: dict[int, tuple[bool, int]] = {}

    def receive(self, data: bytes | memoryview) -> None:
        """Take bytes as they came."""
        self._buffer += data

    def begin_urbs(self) -> None:
        """Say that an import was granted: what follows are URB replies."""
        self._urbs = True

    def expect(self, urb: Submit) -> None:
        """Remember a URB that was sent."""
        self._lengths[urb.seqnum] = (urb.is_in, urb.length)

    def forget(self, seqnum: int) -> None:
        """Drop a URB that was taken back: no reply comes for it."""
        self._lengths.pop(seqnum, None)

    def next_message(self) -> Reply | None:
        """Return the next complete message, None when more bytes are needed; raises UsbipError on a broken one."""
        return self._next_urb() if self._urbs else self._next_operation()

    def _next_operation(self) -> DeviceListReply | ImportReply | None:
        if len(self._buffer) < usbip.OP_HEADER.size:
            return None
        code, status = _operation(self._buffer)
        if code == usbip.REP_IMPORT:
            return self._next_import(status)
        if code == usbip.REP_DEVLIST:
            return self._next_device_list(status)
        raise UsbipError(f"unknown answer 0x{code:04x} to an operation; known are 0x0005 and 0x0003")

    def _next_import(self, status: int) -> ImportReply | None:
        head = usbip.OP_HEADER.size
        if status != OpStatus.OK:
            del self._buffer[:head]
            return ImportReply(status)
        end = head + usbip.RECORD.size
        if len(self._buffer) < end:
            return None
        device = DeviceRecord.parse(_cut(self._buffer, head, end))
        del self._buffer[:end]
        return ImportReply(status, device)

    def _next_device_list(self, status: int) -> DeviceListReply | None:
        if status != OpStatus.OK:
            raise UsbipError(f"the server refused to list its devices (status {status})")
        at = usbip.OP_HEADER.size + usbip.COUNT.size
        if len(self._buffer) < at:
            return None
        (count,) = usbip.COUNT.unpack_from(self._buffer, usbip.OP_HEADER.size)
        if count > self._limits.devices:
            raise UsbipError(f"a list of {count} devices is longer than the limit of {self._limits.devices}")
        devices = []
        for _ in range(count):
            device, at = self._device_at(at)
            if device is None:
                return None
            devices.append(device)
        del self._buffer[:at]
        return DeviceListReply(tuple(devices))

    def _device_at(self, at: int) -> tuple[DeviceRecord | None, int]:
        """Read a record and its interfaces; gives the offset behind them, or no record while bytes are missing."""
        body = at + usbip.RECORD.size
        if len(self._buffer) < body:
            return None, at
        end = body + usbip.INTERFACE.size * self._buffer[body - 1]
        if len(self._buffer) < end:
            return None, at
        interfaces = [(a, b, c) for a, b, c in usbip.INTERFACE.iter_unpack(_cut(self._buffer, body, end))]
        return DeviceRecord.parse(_cut(self._buffer, at, body), interfaces), end

    def _next_urb(self) -> Submitted | Unlinked | None:
        head = usbip.URB_HEADER_BYTES
        if len(self._buffer) < head:
            return None
        command, seqnum, _, _, _, status, actual, *_ = usbip.SUBMITTED.unpack_from(self._buffer)
        if command == usbip.RET_UNLINK:
            del self._buffer[:head]
            return Unlinked(seqnum, status)
        if command != usbip.RET_SUBMIT:
            raise UsbipError(f"unknown URB answer 0x{command:08x}; known are 3 (submitted) and 4 (unlinked)")
        if seqnum not in self._lengths:
            raise UsbipError(f"an answer to URB {seqnum}, which is not pending")
        is_in, length = self._lengths[seqnum]
        _check_length(actual, length)
        end = head + (actual if is_in else 0)
        if len(self._buffer) < end:
            return None
        data = _cut(self._buffer, head, end)
        del self._buffer[:end]
        del self._lengths[seqnum]
        return Submitted(seqnum, status, actual, data)


def _operation(buffer: bytearray) -> tuple[int, int]:
    """Return (code, status) of the operation at the front; raises UsbipError for a version that is not ours."""
    version, code, status = usbip.OP_HEADER.unpack_from(buffer)
    if version != usbip.VERSION:
        raise UsbipError(f"USB/IP version 0x{version:04x}; version 0x{usbip.VERSION:04x} is spoken here")
    return code, status


def _cut(buffer: bytearray, start: int, stop: int) -> bytes:
    """Copy once, where `bytes(buffer[start:stop])` would copy twice."""
    with memoryview(buffer) as view:
        return bytes(view[start:stop])


def _check_length(length: int, limit: int) -> None:
    if length < 0:
        raise UsbipError(f"a transfer cannot have {length} bytes")
    if length > limit:
        raise UsbipError(f"a transfer of {length} bytes is longer than the limit of {limit}")
