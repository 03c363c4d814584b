"""USB/IP server: device models on a TCP port, for `usbip attach` on any Linux machine.

The server runs in one asyncio loop, in the thread that drives the devices: call `pump` after a device got new data.
USB/IP has no authentication and no encryption: every host that may connect can use the camera. It is meant for the
loopback interface, an SSH tunnel, or a private bench network.

A connection without a device is closed when a newer one needs its place; an attached host never is.

    bus id    "B-P": bus number B, port P; the device number is P + 1, as if a hub had address 1
"""

from __future__ import annotations

import asyncio
import logging
import re
import socket
from collections.abc import Callable, Mapping, Sequence
from functools import partial

from firmware_protocol.usb.device import UsbDevice
from firmware_protocol.usb.usbip import DeviceListReply, DeviceRecord, ImportReply, OpStatus
from transports.connections import Admission, Listener, Places, Seat
from transports.network import AllowList, is_loopback
from transports.usb.usbip.connection import Connection, ConnectionSettings, UrbObserver

log = logging.getLogger(__name__)

_PLACES = Places()
_BUSID = re.compile(r"([1-9]\d{0,2})-([1-9]\d{0,2})")


class UsbipServer:
    """Server that offers devices to USB/IP hosts.

    Raises ValueError for a bus id not like "1-1", or an entry of `allow` that is neither an address nor a network.

    Parameters
    ----------
    devices : the devices by bus id, such as "1-1".
    settings : limits and time limits of each connection.
    places : number of simultaneous connections, in all and of one address. Each device needs one.
    allow : addresses and networks that may connect; without any, only this machine.
    observer : observer of every URB.

    Attributes
    ----------
    attend : function that is called before the bytes of a host are processed, and before a host is lost.
    """

    def __init__(
        self,
        devices: Mapping[str, UsbDevice],
        settings: ConnectionSettings | None = None,
        places: Places = _PLACES,
        allow: Sequence[str] = (),
        observer: UrbObserver | None = None,
    ) -> None:
        self._devices = dict(devices)
        for busid in devices:
            _place(busid)
        self._settings = settings or ConnectionSettings()
        self._observer = observer
        self._admission = Admission(AllowList(allow), places)
        self._listener = Listener(self._admission, self._connect)
        self._connections: dict[Connection, Seat | None] = {}
        self._holders: dict[str, Connection] = {}
        self._unplugged: set[str] = set()
        self._idle = asyncio.Event()
        self._idle.set()
        self.attend: Callable[[], None] = lambda: None

    @property
    def attached(self) -> Mapping[str, str]:
        """Bus ids that hosts hold now, and the address of each host."""
        return {busid: connection.peer for busid, connection in self._holders.items()}

    @property
    def port(self) -> int:
        """TCP port of the server; raises RuntimeError before `start`."""
        if self._listener.address is None:
            raise RuntimeError("the USB/IP server is not started")
        return self._listener.address[1]

    @property
    def counts(self) -> Mapping[str, int]:
        """Counts of connections that were refused, or closed for newer ones."""
        return +self._admission.counts

    async def start(self, host: str = "127.0.0.1", port: int = 3240) -> None:
        """Listen on an address; port 0 takes a free one. Raises OSError when the address cannot be used."""
        self._listener.open(host, port)
        if not is_loopback(host):
            log.warning(
                "USB/IP listens on %s without authentication: every host that may connect can use the camera", host
            )

    async def serve(self, sock: socket.socket) -> None:
        """Serve a host at the other end of a connected stream socket, which does not count as a place."""
        await asyncio.get_running_loop().connect_accepted_socket(partial(self._connect, None), sock)

    def pump(self) -> None:
        """Answer pending URBs with the data that the attached devices have now."""
        for connection in tuple(self._holders.values()):
            connection.answer()

    def unplug(self, busid: str) -> None:
        """Remove a device from its host, and from the list, until `plug`."""
        self._unplugged.add(busid)
        if busid in self._holders:
            self._holders[busid].hang_up()

    def plug(self, busid: str) -> None:
        """Offer a device again that was unplugged."""
        self._unplugged.discard(busid)

    async def close(self, linger_s: float = 1.0) -> None:
        """Stop listening, detach devices and drop hosts, which have `linger_s` to read sent data and to close first."""
        await self._listener.close()
        for connection in tuple(self._connections):
            connection.hang_up()
        try:
            await asyncio.wait_for(self._idle.wait(), linger_s)
        except TimeoutError:
            for connection in tuple(self._connections):
                connection.abort()
            await self._idle.wait()

    # Methods of `transports.usb.usbip.connection.Bus`.

    def list_devices(self) -> DeviceListReply:
        """List all devices that are plugged in, including those in use, as usbipd does."""
        plugged = {busid: device for busid, device in self._devices.items() if busid not in self._unplugged}
        return DeviceListReply(tuple(_record(busid, device) for busid, device in plugged.items()))

    def claim(self, busid: str, connection: Connection) -> tuple[ImportReply, UsbDevice | None]:
        """Give a device to a connection, or return the refusal."""
        if busid not in self._devices or busid in self._unplugged:
            return ImportReply(OpStatus.NO_DEVICE), None
        if busid in self._holders:
            return ImportReply(OpStatus.BUSY), None
        self._holders[busid] = connection
        seat = self._connections[connection]
        if seat is not None:
            self._admission.settle(seat)
        return ImportReply(OpStatus.OK, _record(busid, self._devices[busid])), self._devices[busid]

    def closed(self, connection: Connection) -> None:
        """Remove a connection."""
        seat = self._connections.pop(connection, None)
        if seat is not None:
            self._admission.leave(seat)
        self._holders = {busid: holder for busid, holder in self._holders.items() if holder is not connection}
        if not self._connections:
            self._idle.set()

    def _connect(self, seat: Seat | None) -> Connection:
        connection = Connection(self, self._settings, self._observer)
        self._connections[connection] = seat
        self._idle.clear()
        return connection


def _place(busid: str) -> tuple[int, int]:
    """Return bus and port of a bus id; raises ValueError."""
    match = _BUSID.fullmatch(busid)
    if match is None:
        raise ValueError(f"a bus id looks like '1-1' (bus-port, numbers below 1000), got {busid!r}")
    return int(match[1]), int(match[2])


def _record(busid: str, device: UsbDevice) -> DeviceRecord:
    bus, port = _place(busid)
    return DeviceRecord(busid, bus, port + 1, device.identity, f"/sys/devices/evstim/usb{bus}/{busid}")
