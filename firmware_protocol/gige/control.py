"""The control channel of a GigE Vision device: requests in, answers out, and who may write.

One host has control: it wrote PRIVILEGE, and keeps it as long as it sends any request within the heartbeat's time. All
others may read (unless control is exclusive) and search; their writes are refused.

neuromorphic_drivers gives a request 25 ms, then sends the same with a new id and fails on a late answer to the first.
So of requests that waited together, those that are followed by the same of the same host are not answered. A request
that comes again to the bit is answered as before, without being done again.

An answer may be longer than its request, and the sender of a datagram can be forged: hosts without control get so many
answers a second in all, and no more, so that a flood gives back less than it brings.

What the control channel of a camera hands on to its stream, in the order in which it was accepted.

The control channel has checked an order and answered it; the stream carries it out. So both may run in processes of
their own: see `Triton2Control` and `Triton2`.

The message channel: what a camera tells its host unasked.

    message   a GVCP request of the camera, EVENT: u16 0 | u16 event | u16 stream, 0xFFFF none | u16 block | u64 ns
              or EVENTDATA: the same, then the data; of an edge u32 its kind, as in `edges`
    answer    u16 status | u16 EVENT + 1, or EVENTDATA + 1 | u16 0 | u16 id

Where the host has set a timeout, a message asks for an answer and is repeated until it comes, as often as the host has
said; the next one waits meanwhile. Otherwise each is sent once.

Source: GigE Vision 2.0 as implemented in the open by Wireshark's dissector; what viva-genicam answers.
"""

from __future__ import annotations

import ipaddress
import struct
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import NamedTuple, Protocol

from firmware_protocol.gige.gvcp import (
    Action,
    Command,
    ForcedAddress,
    Refused,
    Request,
    Resend,
    Status,
    answer,
    request,
)
from firmware_protocol.gige.registers import DISCOVERY_OCTETS, LONGEST_READ, Memory, Privilege, Register

__all__ = [
    "ACTION_GROUPS",
    "EDGE_EVENT",
    "Control",
    "Controlled",
    "Datagram",
    "DeviceTime",
    "MessageSettings",
    "Messages",
    "Order",
    "Owner",
    "Peer",
    "Pulse",
    "TimeSource",
    "Write",
]


Peer = tuple[str, int]


@dataclass(frozen=True)
class Write:
    """A host wrote a register."""

    address: int
    value: int


@dataclass(frozen=True)
class Pulse:
    """An action gives a pulse on the trigger input, at a time of the device's clock; None: now."""

    time_ns: int | None = None


@dataclass(frozen=True)
class Owner:
    """A host has control from now on; None: nobody has."""

    peer: Peer | None


Order = Write | Resend | Pulse | Owner


class DeviceTime(NamedTuple):
    """The device's clock since the last of so many starts of the acquisition."""

    starts: int
    ns: int


TimeSource = Callable[[], DeviceTime]


ACTION_GROUPS = 1
Datagram = tuple[bytes, Peer]

_NS_PER_MS = 1_000_000
_LEAST_HEARTBEAT_MS = 500
_HEARTBEAT_OFF = 1
_READ = struct.Struct(">IHH")
_STRANGERS_ANSWERS_S = 2000
_OF_THE_OWNER = (
    Register.PRIVILEGE, Register.PRIMARY_PORT, Register.PRIMARY_ADDRESS, Register.STREAM_PORT, Register.MESSAGE_PORT,
)  # fmt: skip
_WRITES = (Command.WRITEREG, Command.WRITEMEM)


class Controlled(Protocol):
    """What the control channel moves beside registers."""

    def check_room(self) -> None:
        """Raise Refused where nothing more can be taken now."""

    def wrote(self, address: int, value: int) -> None:
        """Do what a register written does beside remembering."""

    def taken(self, peer: Peer) -> None:
        """A host has control from now on."""

    def resend(self, asked: Resend) -> None:
        """Send packets of a block once more."""

    def act(self, action: Action) -> Status:
        """Do what an action for this device asks for."""

    def released(self) -> None:
        """Nobody has control any more."""


class Control:
    """Answers hosts.

    Attributes
    ----------
    owner
        The host that has control, or None.
    counts
        Requests by what became of them.
    """

    def __init__(self, memory: Memory, controlled: Controlled) -> None:
        self._memory = memory
        self._controlled = controlled
        self._heard_ns = 0
        self._last: tuple[Peer, bytes, bytes | None] | None = None
        self._for_strangers = _Allowance(_STRANGERS_ANSWERS_S)
        self.owner: Peer | None = None
        self.counts: Counter[str] = Counter()
        self._doing: dict[int, Callable[[Request, Peer], bytes | None]] = {
            Command.DISCOVERY: self._discovery,
            Command.READREG: self._read_registers,
            Command.WRITEREG: self._write_registers,
            Command.READMEM: self._read_memory,
            Command.WRITEMEM: self._write_memory,
            Command.PACKETRESEND: self._resend,
            Command.ACTION: self._act,
            Command.FORCEIP: self._force_address,
        }

    def take(self, datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        """Return the answers to what has come, in order."""
        answers = []
        for place, (data, peer) in enumerate(datagrams):
            if place + 1 < len(datagrams) and _again(data, peer, *datagrams[place + 1]):
                self.counts["requests answered with a later one"] += 1
                continue
            told = self._answer(data, peer, now_ns)
            if told is not None:
                answers.append((told, peer))
        return answers

    def expire(self, now_ns: int) -> None:
        """Take control away from a host that has been silent for longer than it said."""
        if self.owner is None or self._memory.get(Register.GVCP_CONFIGURATION) & _HEARTBEAT_OFF:
            return
        allowed_ms = max(_LEAST_HEARTBEAT_MS, self._memory.get(Register.HEARTBEAT_MS))
        if now_ns - self._heard_ns > allowed_ms * _NS_PER_MS:
            self.counts["heartbeats missed"] += 1
            self.release()

    def release(self) -> None:
        """Take control away from whoever has it."""
        if self.owner is not None:
            self.owner = None
            for register in _OF_THE_OWNER:
                self._memory.set(register, 0)
            self._controlled.released()

    def _answer(self, data: bytes, peer: Peer, now_ns: int) -> bytes | None:
        asked = Request.of(data)
        if asked is None:
            self.counts["datagrams that are no request"] += 1
            return None
        if peer == self.owner:
            self._heard_ns = now_ns
        elif asked.command != Command.PACKETRESEND and not self._for_strangers.take(now_ns):
            self.counts["requests of hosts without control that were too many"] += 1
            return None
        if asked.command in _WRITES and self._last is not None and self._last[:2] == (peer, data):
            return self._last[2]
        told = self._done(asked, peer, now_ns)
        told = told if asked.wants_answer or asked.command == Command.DISCOVERY else None
        self._last = peer, data, told
        return told

    def _done(self, asked: Request, peer: Peer, now_ns: int) -> bytes | None:
        """Do a request and return its answer; None where none is due."""
        try:
            if not asked.whole:
                raise Refused(Status.INVALID_HEADER)
            doing = self._doing.get(asked.command)
            if doing is None:
                raise Refused(Status.NOT_IMPLEMENTED)
            before = self.owner
            told = doing(asked, peer)
            self._heard_ns = self._heard_ns if self.owner is before else now_ns
        except Refused as refused:
            self.counts[f"requests refused: {refused.status.name.lower()}"] += 1
            return answer(asked, status=refused.status)
        self.counts["requests done"] += 1
        return told

    def _discovery(self, asked: Request, peer: Peer) -> bytes:
        return answer(asked, self._memory.read(0, DISCOVERY_OCTETS))

    def _read_registers(self, asked: Request, peer: Peer) -> bytes:
        self._check_read(peer)
        return answer(asked, b"".join(self._memory.read(address, 4) for address in asked.numbers()))

    def _read_memory(self, asked: Request, peer: Peer) -> bytes:
        self._check_read(peer)
        if len(asked.payload) != _READ.size:
            raise Refused(Status.INVALID_PARAMETER)
        address, _, count = _READ.unpack(asked.payload)
        if not 0 < count <= LONGEST_READ:
            raise Refused(Status.INVALID_PARAMETER)
        return answer(asked, asked.payload[:4] + self._memory.read(address, count))

    def _write_registers(self, asked: Request, peer: Peer) -> bytes:
        numbers = asked.numbers()
        if len(numbers) % 2:
            raise Refused(Status.INVALID_PARAMETER)
        pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
        for done, (address, value) in enumerate(pairs):
            try:
                self._write(address, value, peer)
            except Refused as refused:
                return answer(asked, struct.pack(">HH", 0, done), refused.status)
        return answer(asked, struct.pack(">HH", 0, len(pairs)))

    def _write_memory(self, asked: Request, peer: Peer) -> bytes:
        address, *values = asked.numbers()
        for place, value in enumerate(values):
            self._write(address + 4 * place, value, peer)
        return answer(asked, struct.pack(">HH", 0, 4 * len(values)))

    def _write(self, address: int, value: int, peer: Peer) -> None:
        if address == Register.PRIVILEGE:
            self._change_privilege(value, peer)
        elif peer != self.owner:
            raise Refused(Status.ACCESS_DENIED)
        else:
            self._controlled.check_room()
            self._memory.write(address, value)
            self._controlled.wrote(address, value)

    def _change_privilege(self, value: int, peer: Peer) -> None:
        if self.owner not in (None, peer):
            raise Refused(Status.ACCESS_DENIED)
        if not value & (Privilege.CONTROL | Privilege.EXCLUSIVE):
            self.release()
            return
        self._controlled.check_room()
        if self.owner is None:
            self._controlled.taken(peer)
        self.owner = peer
        self._memory.set(Register.PRIVILEGE, value & (Privilege.CONTROL | Privilege.EXCLUSIVE))
        self._memory.set(Register.PRIMARY_PORT, peer[1])
        self._memory.set(Register.PRIMARY_ADDRESS, int(ipaddress.IPv4Address(peer[0])))

    def _check_read(self, peer: Peer) -> None:
        exclusive = self._memory.get(Register.PRIVILEGE) & Privilege.EXCLUSIVE
        if exclusive and peer != self.owner:
            raise Refused(Status.ACCESS_DENIED)

    def _resend(self, asked: Request, peer: Peer) -> bytes:
        """Hand on a request for packets, from the machine that has control alone: the packets go there."""
        if self.owner is None or peer[0] != self.owner[0]:
            raise Refused(Status.ACCESS_DENIED)
        self._controlled.check_room()
        self._controlled.resend(Resend.of(asked))
        return answer(asked)

    def _force_address(self, asked: Request, peer: Peer) -> bytes | None:
        """Refuse another address than ours: it is the machine's; a device that is not meant says nothing."""
        forced = ForcedAddress.of(asked)
        if forced.mac != self._memory.get(Register.MAC_HIGH) << 32 | self._memory.get(Register.MAC_LOW):
            return None
        if self.owner is not None:
            raise Refused(Status.ACCESS_DENIED)
        if forced.address != self._memory.get(Register.ADDRESS):
            raise Refused(Status.NOT_IMPLEMENTED)
        return answer(asked)

    def _act(self, asked: Request, peer: Peer) -> bytes | None:
        """Act where key and group are ours; a device that is not meant says nothing."""
        action = Action.of(asked)
        if action.device_key != self._memory.get(Register.ACTION_DEVICE_KEY):
            return None
        groups = (Register.ACTION_GROUP + 16 * k for k in range(ACTION_GROUPS))
        ours = [(self._memory.get(group), self._memory.get(group + 4)) for group in groups]
        if not any(key == action.group_key and mask & action.group_mask for key, mask in ours):
            return None
        self._controlled.check_room()
        return answer(asked, status=self._controlled.act(action))


class _Allowance:
    """So many of something each second; a second's worth may come at once."""

    def __init__(self, per_s: int) -> None:
        self._per_s = self._left = float(per_s)
        self._renewed_ns = 0

    def take(self, now_ns: int) -> bool:
        """Take one; False when none is left."""
        gained = (now_ns - self._renewed_ns) * 1e-9 * self._per_s
        self._left, self._renewed_ns = min(self._per_s, self._left + gained), now_ns
        if self._left < 1:
            return False
        self._left -= 1
        return True


def _again(data: bytes, peer: Peer, next_data: bytes, next_peer: Peer) -> bool:
    """Tell whether a request is followed by the same one of the same host, but for its id."""
    return peer == next_peer and data[:6] == next_data[:6] and data[8:] == next_data[8:]


EDGE_EVENT = 0x9000
"""The event of an edge on the trigger input; ids from 0x9000 on are the device's own."""

_NO_STREAM = 0xFFFF
_MOST = 256
_PAYLOAD = struct.Struct(">HHHHQ")
_ANSWER = struct.Struct(">HHHH")


@dataclass(frozen=True)
class MessageSettings:
    """How long an answer may take, 0: none is asked for; and how often a message is repeated without one."""

    timeout_ns: int = 0
    retries: int = 0


@dataclass
class _Sent:
    number: int
    command: Command
    payload: bytes
    again_ns: int
    left: int


class Messages:
    """Messages on their way to a host.

    Attributes
    ----------
    counts
        Messages by what became of them.
    """

    def __init__(self) -> None:
        self._waiting: deque[tuple[Command, bytes]] = deque()
        self._sent: _Sent | None = None
        self._number = 0
        self.counts: Counter[str] = Counter()

    def tell(self, event: int, time_ns: int, data: bytes = b"") -> None:
        """Queue a message, an EVENTDATA where there are data; one that finds no room is counted as lost."""
        if len(self._waiting) == _MOST:
            self.counts["messages lost"] += 1
            return
        payload = _PAYLOAD.pack(0, event, _NO_STREAM, 0, time_ns) + data
        self._waiting.append((Command.EVENTDATA if data else Command.EVENT, payload))

    def next(self, now_ns: int, settings: MessageSettings) -> bytes | None:
        """Return the next message to send, or one to send again; None while an answer may still come."""
        if self._sent is not None and now_ns < self._sent.again_ns:
            return None
        if self._sent is not None and self._sent.left == 0:
            self._sent = None
            self.counts["messages lost"] += 1
        if self._sent is None:
            if not self._waiting:
                return None
            self._number = self._number % 0xFFFF + 1
            self._sent = _Sent(self._number, *self._waiting.popleft(), 0, settings.retries + 1)
            self.counts["messages"] += 1
        sent = self._sent
        sent.again_ns, sent.left = now_ns + settings.timeout_ns, sent.left - 1
        if not settings.timeout_ns:
            self._sent = None
        return request(sent.command, sent.number, sent.payload, flags=int(settings.timeout_ns > 0))

    def answered(self, datagram: bytes) -> None:
        """Take what came from the host: the answer to the message that was sent last, or nothing of meaning."""
        if self._sent is None or len(datagram) != _ANSWER.size:
            return
        _, command, _, number = _ANSWER.unpack(datagram)
        if (command, number) == (self._sent.command + 1, self._sent.number):
            self._sent = None

    def clear(self) -> None:
        """Forget what waits; what was not sent is counted as lost."""
        self.counts["messages lost"] += len(self._waiting)
        self._waiting.clear()
        self._sent = None
