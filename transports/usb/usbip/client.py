"""USB/IP host in user space: it attaches to a device and uses it as a driver would, without a kernel module.

All calls are synchronous, in the caller's thread. Transfers of a `UrbStream` stay in flight during control requests:
replies that arrive in between are stored, and a stream submits a URB again only when its data are taken. So no more
than the stream's own URBs are ever stored.

Not modelled: a host controller. There are no packets, no bandwidth limit and no address, and URBs may have any length.

`Wire` is the host's end of a connection: it sends requests, receives whole replies, and raises named errors.
"""

from __future__ import annotations

import contextlib
import socket
import time
from collections import deque
from typing import Self

from firmware_protocol.usb.device import SetupPacket
from firmware_protocol.usb.usbip import (
    DeviceRecord,
    HostParser,
    ImportReply,
    ImportRequest,
    OpStatus,
    Reply,
    Submit,
    Submitted,
    Unlink,
    Unlinked,
    UrbStatus,
    UsbipError,
)
from transports import Closing
from transports.usb.host import (
    DeviceAbsent,
    DeviceBusy,
    PeerBroken,
    PeerGone,
    StallError,
    TransferTimeout,
    UsbHostError,
)

_RECEIVE_BYTES = 256 << 10


def connect(host: str, port: int, timeout_s: float) -> socket.socket:
    """Return a socket to a server; raises PeerGone."""
    try:
        return socket.create_connection((host, port), timeout_s)
    except OSError as error:
        raise PeerGone(f"no USB/IP server at {host}:{port} ({error}); is the emulator running?") from error


class Wire:
    """Socket with the parser of the received data."""

    def __init__(self, sock: socket.socket) -> None:
        self.parser = HostParser()
        self._sock = sock
        self._chunk = memoryview(bytearray(_RECEIVE_BYTES))
        if sock.family in (socket.AF_INET, socket.AF_INET6):
            sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def send(self, data: bytes) -> None:
        """Send a request; raises PeerGone."""
        # Requests are small and few are in flight: a server that accepts none within this time is lost.
        self._sock.settimeout(10.0)
        try:
            self._sock.sendall(data)
        except OSError as error:
            raise PeerGone(f"the USB/IP server went away: {error}") from error

    def receive(self, deadline: float) -> Reply | None:
        """Return the next reply; None if incomplete by `deadline` (monotonic seconds). Raises PeerGone, PeerBroken."""
        while (reply := self._parse()) is None:
            if not self._fill(deadline):
                return None
        return reply

    def close(self) -> None:
        """Close the connection."""
        self._sock.close()

    def _parse(self) -> Reply | None:
        try:
            return self.parser.next_message()
        except UsbipError as error:
            raise PeerBroken(f"the USB/IP server breaks the protocol: {error}") from error

    def _fill(self, deadline: float) -> bool:
        # Read once more after the deadline, without waiting, to get the data that have arrived.
        self._sock.settimeout(max(0.0, deadline - time.monotonic()))
        try:
            n = self._sock.recv_into(self._chunk)
        except (TimeoutError, BlockingIOError):
            return False
        except OSError as error:
            raise PeerGone(f"the USB/IP server went away: {error}") from error
        if n == 0:
            raise PeerGone("the USB/IP server closed the connection")
        self.parser.receive(self._chunk[:n])
        return True


# Linux itself sets this flag for IN transfers (URB_DIR_IN).
_FLAG_IN = 0x200


class UsbipHost(Closing):
    """Device attached over USB/IP.

    Raises DeviceAbsent or DeviceBusy if the server has no such device or another host holds it; PeerGone, PeerBroken
    or TransferTimeout if the server was lost, broke the protocol, or did not answer.

    Parameters
    ----------
    sock : a connected stream socket to a USB/IP server; it is closed with the host.
    busid : the device to import.
    timeout_s : timeout of the import and of each control request.
    """

    def __init__(self, sock: socket.socket, busid: str, timeout_s: float = 1.0) -> None:
        self._wire = Wire(sock)
        self._timeout_s = timeout_s
        self._seqnum = 0
        self._streams: list[UrbStream] = []
        # Destination of the reply to each pending URB.
        self._owners: dict[int, deque[Submitted]] = {}
        self._unlinked: set[int] = set()
        try:
            self.record = self._import(busid)
        except UsbHostError:
            self._wire.close()
            raise
        self.identity = self.record.identity

    @classmethod
    def attach(cls, host: str = "127.0.0.1", port: int = 3240, busid: str = "1-1", timeout_s: float = 1.0) -> Self:
        """Connect to a server and import a device."""
        return cls(connect(host, port, timeout_s), busid, timeout_s)

    def configure(self) -> None:
        """Select the configuration; no interface has to be claimed, because no other program has the device."""
        self.control_out(SetupPacket(0x00, 9, self.identity.configuration_value or 1, 0, 0))

    def clear_halt(self, endpoint: int) -> None:
        """Clear the halt of an IN endpoint."""
        self.control_out(SetupPacket(0x02, 1, 0, 0x80 | endpoint, 0))

    def control_in(self, setup: SetupPacket) -> bytes:
        """Request at most `setup.length` bytes from the device."""
        urb = self._urb(0, is_in=True, length=setup.length, setup=bytes(setup))
        return self._complete(str(setup), urb).data

    def control_out(self, setup: SetupPacket, data: bytes = b"") -> int:
        """Send `data` with a control request; return the number of bytes that the device took."""
        urb = self._urb(0, is_in=False, length=len(data), setup=bytes(setup))
        return self._complete(str(setup), urb._replace(data=data)).actual_length

    def bulk_out(self, endpoint: int, data: bytes) -> None:
        """Send `data` to an OUT endpoint."""
        urb = self._urb(endpoint, is_in=False, length=len(data))
        self._complete(f"endpoint {endpoint}", urb._replace(data=data))

    def bulk_in(self, endpoint: int, length: int) -> bytes:
        """Read one transfer of at most `length` bytes from an IN endpoint."""
        return self._complete(f"endpoint {endpoint}", self._urb(endpoint, is_in=True, length=length)).data

    def stream(self, endpoint: int, transfer_bytes: int = 131_072, transfers: int = 32) -> UrbStream:
        """Start reading an IN endpoint with `transfers` URBs in flight."""
        stream = UrbStream(self, endpoint, transfer_bytes, transfers)
        self._streams.append(stream)
        return stream

    def close(self) -> None:
        """Cancel the pending URBs and detach."""
        for stream in self._streams:
            # A lost server has no URB left to cancel.
            with contextlib.suppress(UsbHostError):
                stream.close()
        self._wire.close()

    # Methods for streams.

    def submit_in(self, endpoint: int, length: int, replies: deque[Submitted]) -> int:
        """Submit an IN URB whose reply goes to `replies`; return its sequence number."""
        urb = self._urb(endpoint, is_in=True, length=length)
        self._submit(urb, replies)
        return urb.seqnum

    def receive(self, deadline: float) -> bool:
        """Receive one reply; return False when none arrived until `deadline` (monotonic seconds)."""
        reply = self._wire.receive(deadline)
        if isinstance(reply, Submitted):
            self._owners.pop(reply.seqnum).append(reply)
        elif isinstance(reply, Unlinked):
            self._unlinked.discard(reply.seqnum)
        elif reply is not None:
            raise PeerBroken(f"unexpected {type(reply).__name__} among URB replies")
        return reply is not None

    def unlink(self, seqnums: list[int]) -> None:
        """Cancel pending URBs and wait until the server has confirmed each."""
        unlinks = [Unlink(self._next_seqnum(), self.record.devid, victim) for victim in seqnums]
        self._unlinked = {unlink.seqnum for unlink in unlinks}
        self._wire.send(b"".join(map(bytes, unlinks)))
        deadline = _deadline(self._timeout_s)
        while self._unlinked:
            if not self.receive(deadline):
                raise TransferTimeout(f"{len(self._unlinked)} URBs were not cancelled within {self._timeout_s:g} s")
        for victim in seqnums:
            self._owners.pop(victim, None)
            self._wire.parser.forget(victim)

    # Internal methods.

    def _import(self, busid: str) -> DeviceRecord:
        self._wire.send(bytes(ImportRequest(busid)))
        reply = self._wire.receive(_deadline(self._timeout_s))
        if reply is None:
            raise TransferTimeout(f"the server did not answer the import of {busid} within {self._timeout_s:g} s")
        if not isinstance(reply, ImportReply):
            raise PeerBroken(f"the server answered the import of {busid} with {reply}")
        if reply.device is None and reply.status == OpStatus.BUSY:
            raise DeviceBusy(f"the server gave device {busid} to another host; detach it there first")
        if reply.device is None:
            raise DeviceAbsent(
                f"the server does not give device {busid} (status {reply.status}); request its list of devices"
            )
        self._wire.parser.begin_urbs()
        return reply.device

    def _next_seqnum(self) -> int:
        self._seqnum = self._seqnum % 0xFFFFFFFF + 1
        return self._seqnum

    def _urb(self, endpoint: int, *, is_in: bool, length: int, setup: bytes = bytes(8)) -> Submit:
        flags = _FLAG_IN if is_in else 0
        return Submit(self._next_seqnum(), self.record.devid, is_in, endpoint, length, setup, flags=flags)

    def _submit(self, urb: Submit, replies: deque[Submitted]) -> None:
        self._owners[urb.seqnum] = replies
        self._wire.parser.expect(urb)
        self._wire.send(bytes(urb))

    def _complete(self, action: str, urb: Submit) -> Submitted:
        """Submit a URB and wait for its answer."""
        replies: deque[Submitted] = deque()
        deadline = _deadline(self._timeout_s)
        self._submit(urb, replies)
        while not replies:
            if not self.receive(deadline):
                self.unlink([urb.seqnum])
                raise TransferTimeout(f"{action}: no answer within {self._timeout_s:g} s")
        return _checked(replies[0], action)


class UrbStream:
    """Data of one IN endpoint, in order, with a number of URBs in flight."""

    def __init__(self, host: UsbipHost, endpoint: int, transfer_bytes: int, transfers: int) -> None:
        self._host = host
        self._endpoint = endpoint
        self._transfer_bytes = transfer_bytes
        self._replies: deque[Submitted] = deque()
        self._pending = deque(self._submit() for _ in range(transfers))
        self._open = True

    def read(self, timeout_s: float) -> bytes | None:
        """Return the next transfer's data; None when none came in time. StallError: halted, PeerGone: server lost."""
        deadline = _deadline(timeout_s)
        while not self._replies:
            if not self._host.receive(deadline):
                return None
        reply = self._replies.popleft()
        due = self._pending.popleft()
        if reply.seqnum != due:
            raise PeerBroken(f"endpoint {self._endpoint}: URB {reply.seqnum} was answered before URB {due}")
        data = _checked(reply, f"endpoint {self._endpoint}").data
        # If the server is lost, earlier data can still be read; the next wait for data raises the error.
        with contextlib.suppress(PeerGone):
            self._pending.append(self._submit())
        return data

    def close(self) -> list[bytes]:
        """Cancel the pending URBs; return the data that had arrived unread, or arrived during the cancellation."""
        if self._open:
            self._open = False
            self._host.unlink(list(self._pending))
        remaining = [reply.data for reply in self._replies]
        self._replies.clear()
        return remaining

    def _submit(self) -> int:
        return self._host.submit_in(self._endpoint, self._transfer_bytes, self._replies)


def _checked(reply: Submitted, action: str) -> Submitted:
    if reply.status == UrbStatus.STALL:
        raise StallError(f"{action}: the device refused (STALL)")
    if reply.status != UrbStatus.OK:
        raise PeerBroken(f"{action}: URB status {reply.status}")
    return reply


def _deadline(timeout_s: float) -> float:
    return time.monotonic() + timeout_s
