"""One connection to the USB/IP server: from the first operation to the last URB.

    CONNECTED --device list--> answered and closed
              --import, free-> ATTACHED --URBs ... peer lost or protocol broken--> closed, device detached
              --import, else-> refused and closed

Guarantees:

- IN URBs of an endpoint are answered in the order of their arrival, each with the result of one `read` of the device;
  while the device has no data they stay pending. Control URBs never wait for them, only for an older control URB.
- While the socket accepts no data, no URB is read from the peer and no data from the device: the device itself drops
  and counts the data that it cannot store.
- Every Transfer read from the device is reported `sent` when the kernel has all its bytes, or `lost` when the
  connection ended first.
- There is no polling: work is done when bytes arrive, when the socket drains, and when `answer` is called.
- A device model that raises any other error than Stall loses its host, like a crashed firmware; asyncio logs the
  error, and the server continues.

`EarlyUnlinks` holds the unlinks that arrived before the URB that they cancel.

Linux's vhci_hcd sends all waiting URBs, then all waiting unlinks. A URB that is queued and cancelled between the two
leaves after its unlink. Any answer to the unlink would then be wrong: if the kernel has not sent the URB yet, it
discards the unlink, and its program waits for the URB for ever; or it returns the URB to the program, does not find it
when its data arrive, and drops the device. libcaer cancels and submits transfers in two threads: tests showed that it
lost the camera in this way, and once waited without end. So the unlink waits for its URB, which then ends like one that
was pending.

Sequence numbers of URBs increase (vhci_hcd numbers them when it queues them), modulo 2^32.
"""

from __future__ import annotations

import asyncio
import logging
import socket
from collections import OrderedDict, deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Protocol

from firmware_protocol.usb.device import NotReady, SetupPacket, Stall, Transfer, UsbDevice
from firmware_protocol.usb.usbip import (
    DeviceListReply,
    DeviceListRequest,
    ImportReply,
    ImportRequest,
    Limits,
    Request,
    ServerParser,
    Submit,
    Submitted,
    Unlink,
    Unlinked,
    UrbStatus,
    UsbipError,
)

_HALF = 1 << 31


class Found(Enum):
    """State of the URB of an unlink."""

    PENDING = "pending"
    OVER = "over, or never seen"
    STILL_TO_COME = "still to come"


class EarlyUnlinks:
    """Unlinks of one connection whose URBs have not arrived, at most `limit`."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._newest: int | None = None
        self._waiting: dict[int, Unlink] = {}

    def submitted(self, seqnum: int) -> Unlink | None:
        """Register a new URB; return the unlink that waited for it."""
        self._newest = seqnum
        return self._waiting.pop(seqnum, None)

    def store(self, unlink: Unlink) -> bool:
        """Store an unlink if its URB has not arrived; return False if it has, or if too many wait."""
        ahead = 1 if self._newest is None else (unlink.victim - self._newest) % (2 * _HALF)
        if not 0 < ahead < _HALF or len(self._waiting) >= self._limit:
            return False
        self._waiting[unlink.victim] = unlink
        return True


log = logging.getLogger(__name__)

_RECEIVED_BYTES = 1 << 16  # asyncio by itself would map and unmap 256 kB of memory for each request of 48 bytes
_DEVICE_GONE = -108  # ESHUTDOWN, as a host sees it


@dataclass(frozen=True)
class ConnectionSettings:
    """Limits and time limits of a connection.

    Attributes
    ----------
    limits : longest transfers.
    pending_urbs : number of URBs that may wait at once; drivers have 8 to 40.
    operation_timeout_s
        A connection that has not requested a device by then is closed, so that idle sockets cannot accumulate.
    silence_timeout_s : A peer that acknowledges nothing, or accepts no data, for this time counts as lost (TCP only;
        whole seconds count for a peer that has nothing to acknowledge).
    send_buffer_bytes : Size of the kernel's buffer to the peer. Data in it count as sent, so it is small: two of the
        largest transfers that drivers request.
    """

    limits: Limits = field(default_factory=Limits)
    pending_urbs: int = 4096
    operation_timeout_s: float = 10.0
    silence_timeout_s: float = 60.0
    send_buffer_bytes: int = 256 << 10


class Bus(Protocol):
    """Interface of the server that a connection uses."""

    attend: Callable[[], None]
    """Function to call before bytes are processed, and before a host is lost: it feeds the devices up to now."""

    def list_devices(self) -> DeviceListReply:
        """Return the answer to a device list request."""

    def claim(self, busid: str, connection: Connection) -> tuple[ImportReply, UsbDevice | None]:
        """Give a device to a connection, or return the refusal."""

    def closed(self, connection: Connection) -> None:
        """Release the device of a connection that has ended."""


class UrbObserver(Protocol):
    """Observer of every URB, at its submission and at its end, and of unlinks."""

    def submitted(self, urb: Submit) -> None:
        """Register a new URB."""

    def completed(self, urb: Submit, status: int, length: int, data: bytes = b"") -> None:
        """Register its end, with the number of bytes moved and the data sent to the host."""

    def unlinked(self, unlink: Unlink, state: Found) -> None:
        """Register that the host cancels a URB, before that URB's end."""


class Connection(asyncio.BufferedProtocol):
    """Server's end of one connection."""

    _transport: asyncio.Transport

    def __init__(self, bus: Bus, settings: ConnectionSettings, observer: UrbObserver | None = None) -> None:
        self._bus = bus
        self._settings = settings
        self._observer = observer
        self._parser = ServerParser(settings.limits)
        self._received = bytearray(_RECEIVED_BYTES)
        self._device: UsbDevice | None = None
        # Endpoint number -> the URBs that wait there by sequence number, oldest first.
        self._pending: dict[int, OrderedDict[int, Submit]] = {}
        self._early_unlinks = EarlyUnlinks(settings.pending_urbs)
        # Setup packet of the oldest control URB; the same object while it waits.
        self._setup: SetupPacket | None = None
        self._unsent: deque[Transfer] = deque()
        self._blocked = False
        self._leaving = False
        self._timeout: asyncio.TimerHandle | None = None
        self.peer = "?"

    # Callbacks of asyncio.

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Store the transport of a connected socket."""
        assert isinstance(transport, asyncio.Transport)
        self._transport = transport
        address = transport.get_extra_info("peername")
        self.peer = f"{address[0]}:{address[1]}" if isinstance(address, tuple) else "local socket"
        _tune(transport.get_extra_info("socket"), self._settings)
        # Blocked as soon as one byte waits: the device holds its data until the socket accepts them.
        transport.set_write_buffer_limits(high=0)
        loop = asyncio.get_running_loop()
        self._timeout = loop.call_later(self._settings.operation_timeout_s, self._operation_overdue)

    def get_buffer(self, sizehint: int) -> bytearray:
        """Return the memory for the next bytes from the peer."""
        return self._received

    def buffer_updated(self, nbytes: int) -> None:
        """Process bytes from the peer."""
        if not self._leaving:
            self._parser.receive(memoryview(self._received)[:nbytes])
            if self._handle_all():
                self.answer()

    def pause_writing(self) -> None:
        """Stop reading, because the socket accepts no data and requests produce answers."""
        self._blocked = True
        self._transport.pause_reading()

    def resume_writing(self) -> None:
        """Continue, because the kernel has accepted everything."""
        self._blocked = False
        self._settle()
        self._handle_all()
        self.answer()
        if not self._blocked:
            self._transport.resume_reading()

    def connection_lost(self, error: Exception | None) -> None:
        """End the connection: no more data reach the peer."""
        if self._timeout:
            self._timeout.cancel()
        if error:
            log.info("%s: connection lost: %s", self.peer, error)
        if self._device:
            self._bus.attend()
        device, self._device = self._device, None
        for urb in [urb for urbs in self._pending.values() for urb in urbs.values()]:
            self._over(urb, _DEVICE_GONE)
        self._pending.clear()
        try:
            if device:
                while self._unsent:
                    device.lost(self._unsent.popleft())
                device.detached()
        finally:
            self._bus.closed(self)

    # Methods for the server.

    def answer(self) -> None:
        """Answer pending IN URBs with the data that the device has now."""
        for endpoint in tuple(self._pending):
            self._answer_all(endpoint)

    def hang_up(self) -> None:
        """End the connection in order: the peer gets the sent data, and closes when it has seen the end.

        Until then its requests are read and dropped: closing a socket with unread requests would reset the connection,
        and data that count as sent would never arrive.
        """
        self._leaving = True
        if self._transport.is_closing():
            return
        try:
            self._transport.write_eof()
        except OSError:  # the peer closed first, and asyncio has not noticed yet
            self._transport.abort()

    def abort(self) -> None:
        """Close at once; unsent data are lost."""
        self._transport.abort()

    @property
    def _writable(self) -> bool:
        return not (self._blocked or self._leaving or self._transport.is_closing())

    # Requests of the peer.

    def _handle_all(self) -> bool:
        """Process the received requests; return True if the device may have an answer that it did not have before.

        The device is fed before a request that can change or report its state. A URB that only waits for data, behind
        others of its endpoint, waits until new data are due.
        """
        is_fed = has_first = False
        try:
            while self._writable:
                message = self._parser.next_message()
                if message is None:
                    break
                if isinstance(message, Submit) and message.is_in and message.endpoint:  # it reads data
                    has_first = has_first or not self._pending.get(message.endpoint)
                else:
                    if not is_fed:
                        self._bus.attend()
                    is_fed = True
                self._handle(message)
        except UsbipError as error:
            log.warning("%s: closed, the peer broke the protocol: %s", self.peer, error)
            self._transport.abort()
            return False
        return is_fed or has_first

    def _handle(self, message: Request) -> None:
        match message:
            case Submit():
                self._submit(message)
            case Unlink():
                self._unlink(message)
            case ImportRequest():
                self._import(message)
            case DeviceListRequest():
                self._transport.write(bytes(self._bus.list_devices()))
                self._transport.close()

    def _import(self, request: ImportRequest) -> None:
        reply, device = self._bus.claim(request.busid, self)
        if device:
            device.attached()
            self._device = device
            self._parser.begin_urbs()
            if self._timeout:
                self._timeout.cancel()
            log.info("%s: attached to %s", self.peer, request.busid)
        self._transport.write(bytes(reply))
        if not device:
            self._transport.close()

    def _submit(self, urb: Submit) -> None:
        if self._observer is not None:
            self._observer.submitted(urb)
        unlink = self._early_unlinks.submitted(urb.seqnum)
        if unlink is not None:
            self._over(urb, UrbStatus.UNLINKED)
            self._transport.write(bytes(Unlinked(unlink.seqnum, UrbStatus.UNLINKED)))
        elif urb.endpoint == 0 or urb.is_in:
            self._queue(urb)
        else:
            self._take(urb)

    def _queue(self, urb: Submit) -> None:
        if any(urb.seqnum in urbs for urbs in self._pending.values()):
            raise UsbipError(f"sequence number {urb.seqnum} is used by two pending URBs")
        answered_at_once = urb.endpoint == 0 and not self._pending.get(0)
        if not answered_at_once and sum(map(len, self._pending.values())) >= self._settings.pending_urbs:
            raise UsbipError(f"more than {self._settings.pending_urbs} URBs pending")
        self._pending.setdefault(urb.endpoint, OrderedDict())[urb.seqnum] = urb
        if urb.endpoint == 0:
            self._answer_all(0)

    def _take(self, urb: Submit) -> None:
        """Pass the data of an OUT URB to the device."""
        assert self._device
        try:
            self._device.write(urb.endpoint, urb.data)
        except Stall:
            self._reply(urb, Submitted(urb.seqnum, UrbStatus.STALL, 0))
        else:
            self._reply(urb, Submitted(urb.seqnum, UrbStatus.OK, len(urb.data)))

    def _unlink(self, unlink: Unlink) -> None:
        if self._early_unlinks.store(unlink):
            self._report_unlink(unlink, Found.STILL_TO_COME)
            return
        if unlink.victim == next(iter(self._pending.get(0, ())), None):
            self._setup = None
        taken = next((urbs.pop(unlink.victim) for urbs in self._pending.values() if unlink.victim in urbs), None)
        self._report_unlink(unlink, Found.OVER if taken is None else Found.PENDING)
        if taken is not None:
            self._over(taken, UrbStatus.UNLINKED)
        # A cancelled URB gets no RET_SUBMIT; one that was answered before keeps its answer.
        self._transport.write(bytes(Unlinked(unlink.seqnum, UrbStatus.OK if taken is None else UrbStatus.UNLINKED)))

    def _control(self, urb: Submit) -> bool:
        """Answer a control URB; False when the device has no answer yet."""
        assert self._device
        setup = self._setup = self._setup or SetupPacket.parse(urb.setup)
        try:
            if setup.length and setup.is_in != urb.is_in:
                raise Stall("the direction of the URB is not that of its setup packet")
            data = self._device.control(setup, urb.data)[: min(setup.length, urb.length)]
        except NotReady:
            return False
        except Stall as stall:
            log.debug("%s: STALL of %s: %s", self.peer, setup, stall)
            reply = Submitted(urb.seqnum, UrbStatus.STALL, 0)
        else:
            reply = Submitted(urb.seqnum, UrbStatus.OK, len(data) if urb.is_in else len(urb.data), data)
        self._setup = None
        del self._pending[0][urb.seqnum]
        self._reply(urb, reply)
        return True

    def _reply(self, urb: Submit, reply: Submitted) -> None:
        if self._observer is not None:
            self._observer.completed(urb, reply.status, reply.actual_length, reply.data)
        # One write, so that header and data leave in one segment.
        self._transport.write(bytes(reply))

    def _report_unlink(self, unlink: Unlink, state: Found) -> None:
        if self._observer is not None:
            self._observer.unlinked(unlink, state)

    def _over(self, urb: Submit, status: int) -> None:
        """Report that a URB has ended without an answer."""
        if self._observer is not None:
            self._observer.completed(urb, status, 0)

    # Data from the device.

    def _answer_all(self, endpoint: int) -> None:
        """Answer the URBs of an endpoint as far as the device can."""
        urbs = self._pending[endpoint]
        while urbs and self._writable and self._answer_one(endpoint, urbs):
            pass

    def _answer_one(self, endpoint: int, urbs: OrderedDict[int, Submit]) -> bool:
        """Answer the oldest URB of an endpoint; return False when the device has no data for it."""
        assert self._device
        seqnum, urb = next(iter(urbs.items()))
        if endpoint == 0:
            return self._control(urb)
        try:
            transfer = self._device.read(endpoint, urb.length)
        except Stall:
            del urbs[seqnum]
            self._reply(urb, Submitted(seqnum, UrbStatus.STALL, 0))
            return True
        if transfer is None:
            return False
        del urbs[seqnum]
        self._unsent.append(transfer)
        self._reply(urb, Submitted(seqnum, UrbStatus.OK, len(transfer.data), transfer.data))
        if self._writable:
            self._settle()
        return True

    def _settle(self) -> None:
        """Report the transfers that the kernel has accepted."""
        while self._unsent and self._device:
            self._device.sent(self._unsent.popleft())

    def _operation_overdue(self) -> None:
        log.warning("%s: closed, no device requested within %g s", self.peer, self._settings.operation_timeout_s)
        self._transport.abort()


def _tune(sock: socket.socket, settings: ConnectionSettings) -> None:
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, settings.send_buffer_bytes)
    if sock.family in (socket.AF_INET, socket.AF_INET6):
        probe_s = max(1, round(settings.silence_timeout_s / 4))
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPIDLE, probe_s)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_KEEPINTVL, probe_s)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, round(1000 * settings.silence_timeout_s))
