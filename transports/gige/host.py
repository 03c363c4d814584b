"""Host of a GigE Vision event camera: it finds the camera, takes control, and reads its stream, without a driver.

`receive` counts, digests and records the arriving events until it is stopped.
"""

from __future__ import annotations

import ipaddress
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.gige.gvcp import GVCP_PORT, Command, Flag, Status, request
from firmware_protocol.gige.gvsp import BlockAssembly
from firmware_protocol.gige.registers import DISCOVERY_OCTETS, DO_NOT_FRAGMENT, Privilege, Register
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, ACQUISITION_STOP
from transports import reception
from transports.link.pacing import Clock
from transports.reception import Arrivals, Reception
from transports.recording.record import Recorder

_TIMEOUT_S = 0.5
_ATTEMPTS = 5
_HEARTBEAT_MS = 6000
_KEEP_ALIVE_NS = 1_000_000_000
_RECEIVE_BUFFER = 1 << 24
_LONGEST = 1 << 16
_AT_A_TIME = 256
_TEXTS = (
    (Register.MANUFACTURER, 32),
    (Register.MODEL, 32),
    (Register.DEVICE_VERSION, 32),
    (Register.SERIAL, 16),
    (Register.USER_NAME, 16),
)
_ANSWER = struct.Struct(">HHHH")

Now = Callable[[], int]


class GigeHostError(Exception):
    """Error: the camera cannot be used; the text gives the reason and the remedy."""


class CameraGone(GigeHostError):
    """Error: the camera does not answer any more, or another host took control."""


@dataclass(frozen=True)
class Identity:
    """Identity that a camera reports."""

    manufacturer: str
    model: str
    version: str
    serial: str
    user_name: str

    @classmethod
    def of(cls, octets: bytes) -> Identity:
        """Return the identity from the answer to a discovery; raises GigeHostError for one that is too short."""
        if len(octets) < DISCOVERY_OCTETS:
            raise GigeHostError(f"the answer to a discovery has {len(octets)} octets, not {DISCOVERY_OCTETS}")
        return cls(*(octets[at : at + room].split(b"\0")[0].decode("ascii", "replace") for at, room in _TEXTS))


class GigeHost:
    """Camera under control of this host.

    Parameters
    ----------
    address, port : address of the camera.
    now_ns : monotonic clock.

    Attributes
    ----------
    identity : identity that the camera reported.
    assembly : assembly of its blocks, with the missing packets.
    """

    def __init__(self, address: str, port: int = GVCP_PORT, *, now_ns: Now) -> None:
        self._now_ns = now_ns
        self._number = 0
        self._stream: socket.socket | None = None
        self._control = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._decoder = Evt3Decoder()
        self._edges: list[Edges] = []
        self._alive_ns = 0
        self._stopped = False
        self.assembly = BlockAssembly()
        try:
            self._control.settimeout(_TIMEOUT_S)
            self._control.connect((address, port))
            self.identity = Identity.of(self._request(Command.DISCOVERY))
            self.write(Register.PRIVILEGE, Privilege.CONTROL)
        except OSError as error:
            self._control.close()
            raise GigeHostError(f"cannot reach {address} port {port}: {error.strerror}") from error
        except GigeHostError:
            self._control.close()
            raise

    def read_register(self, address: int) -> int:
        """Return a register of the camera; raises GigeHostError when it refuses, CameraGone when it does not answer."""
        return int.from_bytes(self._request(Command.READREG, struct.pack(">I", address)), "big")

    def write(self, address: int, value: int) -> None:
        """Write a register of the camera; raises as `read_register`."""
        self._request(Command.WRITEREG, struct.pack(">II", address, value & 0xFFFFFFFF))

    def start(self, packet_size: int = 1400) -> None:
        """Open the stream and start the acquisition."""
        self._stream = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._stream.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _RECEIVE_BUFFER)
        address = self._control.getsockname()[0]
        self._stream.bind((address, 0))
        self.write(Register.HEARTBEAT_MS, _HEARTBEAT_MS)
        self.write(Register.PACKET_SIZE, DO_NOT_FRAGMENT | packet_size)
        self.write(Register.STREAM_ADDRESS, int(ipaddress.IPv4Address(address)))
        self.write(Register.STREAM_PORT, self._stream.getsockname()[1])
        self.write(ACQUISITION_START, 1)
        self._stopped = False
        self._alive_ns = self._now_ns()

    def read(self, timeout_s: float) -> Events:
        """Return the events, (n,) EVENT in the camera's time, that arrived within `timeout_s`; may be empty."""
        assert self._stream is not None
        self._stream.settimeout(timeout_s)
        data: list[bytes] = []
        with suppress(TimeoutError, BlockingIOError):
            data += self.assembly.push(self._stream.recv(_LONGEST), self._now_ns())
            self._stream.setblocking(False)
            for _ in range(_AT_A_TIME):
                data += self.assembly.push(self._stream.recv(_LONGEST), self._now_ns())
        self._maintain()
        data += self.assembly.done(self._now_ns())
        events, edges = self._decoder.decode(b"".join(data)) if data else (empty_events(), empty_edges())
        if len(edges):
            self._edges.append(edges)
        return events

    def take_edges(self) -> Edges:
        """Return the triggers since the last call, (n,) EDGE in the camera's time."""
        edges, self._edges = self._edges, []
        return np.concatenate(edges) if edges else empty_edges()

    def stop(self) -> None:
        """Stop the acquisition; data that have left the camera can still be read."""
        self.write(ACQUISITION_STOP, 1)
        self._stopped = True

    def close(self) -> None:
        """Release control and close the sockets; a lost camera gets no request."""
        with suppress(GigeHostError, OSError):
            self.write(Register.PRIVILEGE, 0)
        self._control.close()
        if self._stream is not None:
            self._stream.close()

    def _maintain(self) -> None:
        """Request missing packets, and keep control."""
        for resend in self.assembly.missing(self._now_ns(), over=self._stopped):
            payload = struct.pack(">IIIQ", 0, resend.first, resend.last, resend.block)
            self._control.send(request(Command.PACKETRESEND, self._next_number(), payload, Flag.EXTENDED))
        if self._now_ns() - self._alive_ns > _KEEP_ALIVE_NS:
            if not self.read_register(Register.PRIVILEGE) & Privilege.CONTROL:
                raise CameraGone("control was taken away: another host has the camera, or it was restarted")
            self._alive_ns = self._now_ns()

    def _next_number(self) -> int:
        self._number = self._number % 0xFFFF + 1
        return self._number

    def _request(self, command: Command, payload: bytes = b"") -> bytes:
        """Return the payload of the answer to a request, which is repeated until an answer arrives."""
        number = self._next_number()
        data = request(command, number, payload, Flag.ACKNOWLEDGE)
        for _ in range(_ATTEMPTS):
            try:
                self._control.send(data)
                answer = self._answer_to(number)
            except (TimeoutError, ConnectionRefusedError):
                continue
            status, _, _, _ = _ANSWER.unpack_from(answer)
            if status != Status.SUCCESS:
                raise GigeHostError(f"the camera refused {command.name}: {_status_text(status)}")
            return answer[_ANSWER.size :]
        raise CameraGone(f"no camera answers at {self._peer()}: is its run started, and is this host in its `allow`?")

    def _answer_to(self, number: int) -> bytes:
        while True:
            answer = self._control.recv(_LONGEST)
            if len(answer) >= _ANSWER.size and _ANSWER.unpack_from(answer)[3] == number:
                return answer

    def _peer(self) -> str:
        try:
            host, port = self._control.getpeername()
        except OSError:
            return "its address"
        return f"{host}:{port}"


def _status_text(status: int) -> str:
    try:
        name = Status(status).name.lower().replace("_", " ")
    except ValueError:
        return f"status {status:#06x}"
    return f"{name}; another host has control" if status == Status.ACCESS_DENIED else name


_READ_TIMEOUT_S = 0.1


@dataclass(frozen=True)
class GigeReception(Reception):
    """Events and triggers received so far from a GigE Vision camera, in device time.

    Attributes
    ----------
    blocks_lost : number of incomplete blocks.
    packets_requested, packets_repeated : numbers of packets that were requested again, and that arrived more than once.
    """

    blocks_lost: int = 0
    packets_requested: int = 0
    packets_repeated: int = 0


def receive(
    camera: GigeHost,
    packet_size: int,
    goes_on: Callable[[GigeReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
) -> GigeReception:
    """Start the camera, read until `goes_on` returns False or it is lost, stop it. GigeHostError: it did not start."""
    camera.start(packet_size)
    arrivals = Arrivals(clock, recorder)

    def now(*, gone: bool = False) -> GigeReception:
        of = camera.assembly
        counts = {"blocks_lost": of.lost, "packets_requested": of.requested, "packets_repeated": of.repeated}
        return arrivals.reception(GigeReception, gone=gone, faults=of.lost, **counts)

    def turn() -> None:
        arrivals.add(camera.read(_READ_TIMEOUT_S), camera.take_edges(), clock.now_ns())

    def stop() -> None:
        camera.stop()
        before = -1
        while arrivals.events > before or camera.assembly.waiting:
            before = arrivals.events
            turn()

    return now(gone=reception.receive(now, goes_on, turn, stop=stop, lost=CameraGone))
