"""A host of a GigE Vision event camera: finds it, takes control, and reads its stream, without a driver.

A reader of a GigE Vision event camera that counts, digests and records what arrives, until told to stop.
"""

from __future__ import annotations

import dataclasses
import ipaddress
import socket
import struct
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from firmware_protocol.events import Edges, Events, empty_edges, empty_events
from firmware_protocol.evt.evt3 import Evt3Decoder
from firmware_protocol.gige.gvcp import GVCP_PORT, Command, Flag, Resend, Status, request
from firmware_protocol.gige.gvsp import BlockAssembly
from firmware_protocol.gige.registers import ACQUISITION_START, ACQUISITION_STOP, DISCOVERY_OCTETS, Privilege, Register
from firmware_protocol.gige.triton2_registers import DO_NOT_FRAGMENT
from transports.link.deliveries import digest_of
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder

__all__ = ["CameraGone", "GigeHost", "GigeHostError", "GigeReception", "Identity", "receive"]


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
    """The camera cannot be used; the text says why and what to do."""


class CameraGone(GigeHostError):
    """The camera does not answer any more, or somebody took control away."""


@dataclass(frozen=True)
class Identity:
    """What a camera tells of itself."""

    manufacturer: str
    model: str
    version: str
    serial: str
    user_name: str

    @classmethod
    def of(cls, octets: bytes) -> Identity:
        """Return it from the answer to a discovery; raises GigeHostError for one that is too short."""
        if len(octets) < DISCOVERY_OCTETS:
            raise GigeHostError(f"the answer to a discovery has {len(octets)} octets, not {DISCOVERY_OCTETS}")
        return cls(*(octets[at : at + room].split(b"\0")[0].decode("ascii", "replace") for at, room in _TEXTS))


class GigeHost:
    """A camera under control.

    Parameters
    ----------
    address, port
        Of the camera.
    now_ns
        A clock that does not go back.

    Attributes
    ----------
    identity
        What the camera told.
    assembly
        Its blocks, and what was missing.
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
            self.identity = Identity.of(self._ask(Command.DISCOVERY))
            self.write(Register.PRIVILEGE, Privilege.CONTROL)
        except OSError as error:
            self._control.close()
            raise GigeHostError(f"cannot reach {address} port {port}: {error.strerror}") from error
        except GigeHostError:
            self._control.close()
            raise

    def read_register(self, address: int) -> int:
        """Return a register of the camera; raises GigeHostError when it refuses, CameraGone when it is silent."""
        return int.from_bytes(self._ask(Command.READREG, struct.pack(">I", address)), "big")

    def write(self, address: int, value: int) -> None:
        """Write a register of the camera; raises as `read_register`."""
        self._ask(Command.WRITEREG, struct.pack(">II", address, value & 0xFFFFFFFF))

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
        """Return the events, (n,) EVENT in the camera's time, of what came within `timeout_s`; maybe none."""
        assert self._stream is not None
        self._stream.settimeout(timeout_s)
        data: list[bytes] = []
        with suppress(TimeoutError, BlockingIOError):
            data += self.assembly.push(self._stream.recv(_LONGEST), self._now_ns())
            self._stream.setblocking(False)
            for _ in range(_AT_A_TIME):
                data += self.assembly.push(self._stream.recv(_LONGEST), self._now_ns())
        self._care()
        data += self.assembly.done(self._now_ns())
        return self._decoded(data)

    def take_edges(self) -> Edges:
        """Return the triggers since the last call, (n,) EDGE in the camera's time."""
        edges, self._edges = self._edges, []
        return np.concatenate(edges) if edges else empty_edges()

    def stop(self) -> None:
        """Stop the acquisition; what has left the camera can still be read."""
        self.write(ACQUISITION_STOP, 1)
        self._stopped = True

    def close(self) -> None:
        """Give control back and close the sockets; a camera that is gone is left alone."""
        with suppress(GigeHostError, OSError):
            self.write(Register.PRIVILEGE, 0)
        self._control.close()
        if self._stream is not None:
            self._stream.close()

    def _decoded(self, data: list[bytes]) -> Events:
        events, edges = self._decoder.decode(b"".join(data)) if data else (empty_events(), empty_edges())
        if len(edges):
            self._edges.append(edges)
        return events

    def _care(self) -> None:
        """Ask for packets that are missing, and keep control."""
        for wanted in self.assembly.missing(self._now_ns(), over=self._stopped):
            self._control.send(_resend(self._next_number(), wanted))
        if self._now_ns() - self._alive_ns > _KEEP_ALIVE_NS:
            if not self.read_register(Register.PRIVILEGE) & Privilege.CONTROL:
                raise CameraGone("control was taken away: another host has the camera, or it was started anew")
            self._alive_ns = self._now_ns()

    def _next_number(self) -> int:
        self._number = self._number % 0xFFFF + 1
        return self._number

    def _ask(self, command: Command, payload: bytes = b"") -> bytes:
        """Return the payload of the answer to a request, which is repeated while none comes."""
        number = self._next_number()
        asked = request(command, number, payload, Flag.ACKNOWLEDGE)
        for _ in range(_ATTEMPTS):
            try:
                self._control.send(asked)
                answer = self._answer_to(number)
            except (TimeoutError, ConnectionRefusedError):
                continue
            status, _, _, _ = _ANSWER.unpack_from(answer)
            if status != Status.SUCCESS:
                raise GigeHostError(f"the camera refused {command.name}: {_told(status)}")
            return answer[_ANSWER.size :]
        raise CameraGone(f"no camera answers at {self._peer()}: is its run started, and does its `allow` name us?")

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


def _resend(number: int, wanted: Resend) -> bytes:
    payload = struct.pack(">IIIQ", 0, wanted.first, wanted.last, wanted.block)
    return request(Command.PACKETRESEND, number, payload, Flag.EXTENDED)


def _told(status: int) -> str:
    try:
        name = Status(status).name.lower().replace("_", " ")
    except ValueError:
        return f"status {status:#06x}"
    return f"{name}; another host has control" if status == Status.ACCESS_DENIED else name


_READ_TIMEOUT_S = 0.1


@dataclass(frozen=True)
class GigeReception:
    """What has arrived so far.

    Attributes
    ----------
    seconds
        Wall time since the stream was started.
    last_t_us
        Device time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    edges
        Triggers.
    blocks_lost
        Blocks that did not come whole.
    packets_asked, packets_repeated
        Packets that were asked for again, and that came more than once.
    gone
        True when the camera went away.
    """

    events: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    edges: int = 0
    blocks_lost: int = 0
    packets_asked: int = 0
    packets_repeated: int = 0
    gone: bool = False

    def with_events(self, events: Events) -> GigeReception:
        """Return this and `events`, (n,) EVENT in device time."""
        if not len(events):
            return self
        return dataclasses.replace(
            self,
            events=self.events + len(events),
            last_t_us=int(events["t"][-1]),
            digest=digest_of(events, self.digest),
        )


def receive(
    camera: GigeHost,
    packet_size: int,
    goes_on: Callable[[GigeReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
) -> GigeReception:
    """Start the camera and read it while `goes_on` says so; then stop it.

    A camera that goes away ends it too. Raises GigeHostError when the camera cannot be started.
    """
    reception = GigeReception()
    camera.start(packet_size)
    start_ns = clock.now_ns()
    try:
        while goes_on(reception):
            reception = _turn(camera, reception, recorder)
            reception = dataclasses.replace(reception, seconds=(clock.now_ns() - start_ns) * 1e-9)
        camera.stop()
        before = -1
        while reception.events > before or camera.assembly.waiting:
            before, reception = reception.events, _turn(camera, reception, recorder)
    except CameraGone:
        return dataclasses.replace(reception, gone=True)
    return reception


def _turn(camera: GigeHost, reception: GigeReception, recorder: Recorder | None) -> GigeReception:
    """Return the reception with what has come since the last turn."""
    events = camera.read(_READ_TIMEOUT_S)
    edges = camera.take_edges()
    if recorder is not None and (len(events) or len(edges)):
        recorder.append(Part(events, edges))
    return dataclasses.replace(
        reception.with_events(events),
        edges=reception.edges + len(edges),
        blocks_lost=camera.assembly.lost,
        packets_asked=camera.assembly.requested,
        packets_repeated=camera.assembly.repeated,
    )
