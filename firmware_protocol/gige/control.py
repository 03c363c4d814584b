"""The control channel of a GigE Vision device: requests in, answers out, and who may write.

One host has control: it wrote PRIVILEGE, and keeps it as long as it sends any request within the heartbeat's time. All
others may read (unless control is exclusive) and search; their writes are refused.

neuromorphic_drivers gives a request 25 ms, then sends the same with a new id and fails on a late answer to the first.
So of requests that waited together, those that are followed by the same of the same host are not answered. A request
that comes again to the bit is answered as before, without being done again.

An answer may be longer than its request, and the sender of a datagram can be forged: hosts without control get so many
answers a second in all, and no more, so that a flood gives back less than it brings.
"""

from __future__ import annotations

import ipaddress
import struct
from collections import Counter
from collections.abc import Callable, Sequence
from typing import Protocol

from firmware_protocol.gige.bootstrap import DISCOVERY_OCTETS, Privilege, Register
from firmware_protocol.gige.gvcp import Action, Command, ForcedAddress, Refused, Request, Resend, Status, answer
from firmware_protocol.gige.memory import LONGEST_READ, Memory
from firmware_protocol.gige.orders import Peer

__all__ = ["ACTION_GROUPS", "Control", "Controlled", "Datagram"]

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
