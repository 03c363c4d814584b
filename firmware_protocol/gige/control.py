"""The control channel of a GigE Vision device: requests, answers and write access; the message channel to its host.

One host has control: it wrote PRIVILEGE, and keeps control as long as it sends any request within the heartbeat's time.
All others may read (unless control is exclusive) and search; their writes are refused.

neuromorphic_drivers waits 25 ms for an answer, then sends the same request with a new id and fails on a late answer to
the first. So if requests wait together, one that is followed by the same request of the same host is not answered. A
request that arrives again, identical in all bits, gets the previous answer and is not executed again.

An answer may be longer than its request, and the sender of a datagram can be forged. So the answers to hosts without
control are limited to a number per second in all: a flood of requests cannot make a larger flood of answers.

The control channel checks and answers a request; if the stream has to act, it passes an order on, and the stream
executes the orders in the sequence in which they were accepted. So both may run in processes of their own: see
`Triton2Control` and `Triton2`.

The message channel carries the camera's messages to its host:

    message   a GVCP request of the camera, EVENT: u16 0 | u16 event | u16 stream, 0xFFFF none | u16 block | u64 ns
              or EVENTDATA: the same, then the data; of an edge u32 its kind, as in `edges`
    answer    u16 status | u16 EVENT + 1, or EVENTDATA + 1 | u16 0 | u16 id

If the host has set a timeout, a message requires an answer, and is repeated until it arrives, at most as often as the
host has set; the next message waits meanwhile. Otherwise each message is sent once.

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
    Flag,
    ForcedAddress,
    Refused,
    Request,
    Resend,
    Status,
    answer,
    request,
)
from firmware_protocol.gige.registers import ACTION_GROUPS, DISCOVERY_OCTETS, LONGEST_READ, Memory, Privilege, Register

Peer = tuple[str, int]


@dataclass(frozen=True)
class Write:
    """Order: a host wrote a register."""

    address: int
    value: int


@dataclass(frozen=True)
class Pulse:
    """Order: an action gives a pulse on the trigger input, at a time of the device's clock; None: now."""

    time_ns: int | None = None


@dataclass(frozen=True)
class Owner:
    """Order: a host has control from now on; None: no host has."""

    peer: Peer | None


Order = Write | Resend | Pulse | Owner


class DeviceTime(NamedTuple):
    """The device's clock since the last start of the acquisition, and the number of starts."""

    starts: int
    ns: int


TimeSource = Callable[[], DeviceTime]


Datagram = tuple[bytes, Peer]

_NS_PER_MS = 1_000_000
_LEAST_HEARTBEAT_MS = 500
_HEARTBEAT_OFF = 1
_READ = struct.Struct(">IHH")
_OTHERS_ANSWERS_S = 2000
_OF_THE_OWNER = (
    Register.PRIVILEGE, Register.PRIMARY_PORT, Register.PRIMARY_ADDRESS, Register.STREAM_PORT, Register.MESSAGE_PORT,
)  # fmt: skip
_WRITES = (Command.WRITEREG, Command.WRITEMEM)


class Controlled(Protocol):
    """Parts of the device that requests act on, beside its registers."""

    def check_room(self) -> None:
        """Raise Refused if no further order can be accepted now."""

    def wrote(self, address: int, value: int) -> None:
        """Apply the effect of a register that was written, beyond storing its value."""

    def taken(self, peer: Peer) -> None:
        """Note that a host has control from now on."""

    def resend(self, request: Resend) -> None:
        """Send packets of a block once more."""

    def act(self, action: Action) -> Status:
        """Execute an action for this device."""

    def released(self) -> None:
        """Note that no host has control any more."""


class Control:
    """Server of the control channel. `owner`: the host that has control, or None; `counts`: requests by outcome."""

    def __init__(self, memory: Memory, controlled: Controlled) -> None:
        self._memory = memory
        self._controlled = controlled
        self._last_request_ns = 0
        self._last: tuple[Peer, bytes, bytes | None] | None = None
        self._for_others = _Allowance(_OTHERS_ANSWERS_S)
        self.owner: Peer | None = None
        self.counts: Counter[str] = Counter()
        self._handlers: dict[int, Callable[[Request, Peer], bytes | None]] = {
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
        """Return the answers to the datagrams received, in order."""
        answers = []
        followers: list[tuple[bytes, Peer | None]] = [*datagrams[1:], (b"", None)]
        for (data, peer), (next_data, next_peer) in zip(datagrams, followers, strict=False):
            # The next request is the same one of the same host, except for its id.
            if peer == next_peer and data[:6] == next_data[:6] and data[8:] == next_data[8:]:
                self.counts["requests answered with a later one"] += 1
                continue
            reply = self._answer(data, peer, now_ns)
            if reply is not None:
                answers.append((reply, peer))
        return answers

    def expire(self, now_ns: int) -> None:
        """Withdraw control from a host that has been silent for longer than its heartbeat allows."""
        if self.owner is None or self._memory.get(Register.GVCP_CONFIGURATION) & _HEARTBEAT_OFF:
            return
        allowed_ms = max(_LEAST_HEARTBEAT_MS, self._memory.get(Register.HEARTBEAT_MS))
        if now_ns - self._last_request_ns > allowed_ms * _NS_PER_MS:
            self.counts["heartbeats missed"] += 1
            self.release()

    def release(self) -> None:
        """Withdraw control from the host that has it."""
        if self.owner is not None:
            self.owner = None
            for register in _OF_THE_OWNER:
                self._memory.set(register, 0)
            self._controlled.released()

    def _answer(self, data: bytes, peer: Peer, now_ns: int) -> bytes | None:
        request = Request.of(data)
        if request is None:
            self.counts["datagrams that are no request"] += 1
            return None
        if peer == self.owner:
            self._last_request_ns = now_ns
        elif request.command != Command.PACKETRESEND and not self._for_others.take(now_ns):
            self.counts["requests of hosts without control that were too many"] += 1
            return None
        if request.command in _WRITES and self._last is not None and self._last[:2] == (peer, data):
            return self._last[2]
        reply = self._done(request, peer, now_ns)
        reply = reply if request.flags & Flag.ACKNOWLEDGE or request.command == Command.DISCOVERY else None
        self._last = peer, data, reply
        return reply

    def _done(self, request: Request, peer: Peer, now_ns: int) -> bytes | None:
        """Execute a request and return its answer; None if it has none."""
        try:
            if not request.is_complete:
                raise Refused(Status.INVALID_HEADER)
            handler = self._handlers.get(request.command)
            if handler is None:
                raise Refused(Status.NOT_IMPLEMENTED)
            before = self.owner
            reply = handler(request, peer)
            self._last_request_ns = self._last_request_ns if self.owner is before else now_ns
        except Refused as refused:
            self.counts[f"requests refused: {refused.status.name.lower()}"] += 1
            return answer(request, status=refused.status)
        self.counts["requests done"] += 1
        return reply

    def _discovery(self, request: Request, peer: Peer) -> bytes:
        return answer(request, self._memory.read(0, DISCOVERY_OCTETS))

    def _read_registers(self, request: Request, peer: Peer) -> bytes:
        self._check_read(peer)
        return answer(request, b"".join(self._memory.read(address, 4) for address in request.numbers()))

    def _read_memory(self, request: Request, peer: Peer) -> bytes:
        self._check_read(peer)
        if len(request.payload) != _READ.size:
            raise Refused(Status.INVALID_PARAMETER)
        address, _, count = _READ.unpack(request.payload)
        if not 0 < count <= LONGEST_READ:
            raise Refused(Status.INVALID_PARAMETER)
        return answer(request, request.payload[:4] + self._memory.read(address, count))

    def _write_registers(self, request: Request, peer: Peer) -> bytes:
        numbers = request.numbers()
        if len(numbers) % 2:
            raise Refused(Status.INVALID_PARAMETER)
        pairs = list(zip(numbers[::2], numbers[1::2], strict=True))
        for done, (address, value) in enumerate(pairs):
            try:
                self._write(address, value, peer)
            except Refused as refused:
                return answer(request, struct.pack(">HH", 0, done), refused.status)
        return answer(request, struct.pack(">HH", 0, len(pairs)))

    def _write_memory(self, request: Request, peer: Peer) -> bytes:
        address, *values = request.numbers()
        for place, value in enumerate(values):
            self._write(address + 4 * place, value, peer)
        return answer(request, struct.pack(">HH", 0, 4 * len(values)))

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

    def _resend(self, request: Request, peer: Peer) -> bytes:
        """Pass on a request for packets, only from the machine that has control: the packets go there."""
        if self.owner is None or peer[0] != self.owner[0]:
            raise Refused(Status.ACCESS_DENIED)
        self._controlled.check_room()
        self._controlled.resend(Resend.of(request))
        return answer(request)

    def _force_address(self, request: Request, peer: Peer) -> bytes | None:
        """Refuse any other address than the device's own, which the machine sets; ignore one for another device."""
        forced = ForcedAddress.of(request)
        if forced.mac != self._memory.get(Register.MAC_HIGH) << 32 | self._memory.get(Register.MAC_LOW):
            return None
        if self.owner is not None:
            raise Refused(Status.ACCESS_DENIED)
        if forced.address != self._memory.get(Register.ADDRESS):
            raise Refused(Status.NOT_IMPLEMENTED)
        return answer(request)

    def _act(self, request: Request, peer: Peer) -> bytes | None:
        """Execute an action if key and group are this device's; give no answer otherwise."""
        action = Action.of(request)
        if action.device_key != self._memory.get(Register.ACTION_DEVICE_KEY):
            return None
        groups = (Register.ACTION_GROUP + 16 * k for k in range(ACTION_GROUPS))
        ours = [(self._memory.get(group), self._memory.get(group + 4)) for group in groups]
        if not any(key == action.group_key and mask & action.group_mask for key, mask in ours):
            return None
        self._controlled.check_room()
        return answer(request, status=self._controlled.act(action))


class _Allowance:
    """Limit of a number per second; the number of one second may come at once."""

    def __init__(self, per_s: int) -> None:
        self._per_s = self._left = float(per_s)
        self._renewed_ns = 0

    def take(self, now_ns: int) -> bool:
        """Take one; False if none is left."""
        gained = (now_ns - self._renewed_ns) * 1e-9 * self._per_s
        self._left, self._renewed_ns = min(self._per_s, self._left + gained), now_ns
        if self._left < 1:
            return False
        self._left -= 1
        return True


EDGE_EVENT = 0x9000
"""The event of an edge on the trigger input; ids from 0x9000 on are the device's own."""

_NO_STREAM = 0xFFFF
_MOST = 256
_PAYLOAD = struct.Struct(">HHHHQ")
_ANSWER = struct.Struct(">HHHH")


@dataclass(frozen=True)
class MessageSettings:
    """Time allowed for an answer, 0: no answer is requested; and how many times a message is repeated without one."""

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
    """Queue of messages to a host; `counts`: messages by outcome."""

    def __init__(self) -> None:
        self._waiting: deque[tuple[Command, bytes]] = deque()
        self._sent: _Sent | None = None
        self._number = 0
        self.counts: Counter[str] = Counter()

    def queue(self, event: int, time_ns: int, data: bytes = b"") -> None:
        """Queue a message, an EVENTDATA if there are data; one that finds no room is counted as lost."""
        if len(self._waiting) == _MOST:
            self.counts["messages lost"] += 1
            return
        payload = _PAYLOAD.pack(0, event, _NO_STREAM, 0, time_ns) + data
        self._waiting.append((Command.EVENTDATA if data else Command.EVENT, payload))

    def next(self, now_ns: int, settings: MessageSettings) -> bytes | None:
        """Return the next message to send, or one to send again; None while an answer may still arrive."""
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
        """Process a datagram of the host: the answer to the last message; anything else is ignored."""
        if self._sent is None or len(datagram) != _ANSWER.size:
            return
        _, command, _, number = _ANSWER.unpack(datagram)
        if (command, number) == (self._sent.command + 1, self._sent.number):
            self._sent = None

    def clear(self) -> None:
        """Empty the queue; messages that were not sent are counted as lost."""
        self.counts["messages lost"] += len(self._waiting)
        self._waiting.clear()
        self._sent = None
