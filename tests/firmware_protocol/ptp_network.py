"""A master, a path and a slave's local clock for tests, in closed form: nothing here is read by the code under test."""

from __future__ import annotations

import random
import struct
from dataclasses import dataclass

from firmware_protocol.ptp.messages import (
    Announce,
    DelayResponse,
    Flag,
    FollowUp,
    Header,
    MessageType,
    PortIdentity,
    Sync,
)
from firmware_protocol.ptp.slave import Slave

SLAVE = 0x1C0FAF_FFFE_123456
S = 1_000_000_000
CONTROL = {MessageType.SYNC: 0, MessageType.FOLLOW_UP: 2, MessageType.DELAY_RESP: 3, MessageType.ANNOUNCE: 5}


def packed(header, body):
    """Octets of a message of a master."""
    head = (header.type, 2, 34 + len(body), header.domain, 0, header.flags, header.correction_ns << 16)
    head += (*header.source, header.sequence, CONTROL[header.type], header.log_interval)
    return struct.pack(">BBHBBHq4xQHHBb", *head) + body


def packed_time(time_ns):
    seconds, nanoseconds = divmod(time_ns, S)
    return struct.pack(">HII", seconds >> 32, seconds & 0xFFFFFFFF, nanoseconds)


def sync(message):
    return packed(message.header, packed_time(message.time_ns))


follow_up = sync


def delay_response(message):
    return packed(message.header, packed_time(message.time_ns) + struct.pack(">QH", *message.requester))


def announce(message):
    numbers = (message.utc_offset_s, *message.quality, message.grandmaster, message.steps_removed, message.time_source)
    return packed(message.header, struct.pack(">10xhxBBBHBQHB", *numbers))


@dataclass
class Master:
    """A master whose time is the true time plus `ahead_ns`."""

    identity: int = 0xA0A0A0_FFFE_000001
    priority: int = 128
    ahead_ns: int = 1_700_000_000 * S
    two_step: bool = True
    log_announce: int = 0
    log_sync: int = -2
    log_request: int = -2
    correction_ns: int = 0
    sequence: int = 0
    quiet: bool = False

    @property
    def port(self):
        return PortIdentity(self.identity, 1)

    def header(self, kind, log, flags=0, correction_ns=0):
        return Header(kind, 0, self.port, self.sequence, flags, correction_ns, log)

    def announce(self):
        quality = (self.priority, 248, 0xFE, 0xFFFF, 128)
        return announce(Announce(self.header(MessageType.ANNOUNCE, self.log_announce), quality, self.identity, 0))

    def syncs(self, true_ns):
        """Messages of a Sync that leaves at a true time: in one step or in two."""
        self.sequence = (self.sequence + 1) & 0xFFFF
        left_ns = true_ns + self.ahead_ns
        if not self.two_step:
            return [sync(Sync(self.header(MessageType.SYNC, self.log_sync, 0, self.correction_ns), left_ns))]
        first = sync(Sync(self.header(MessageType.SYNC, self.log_sync, Flag.TWO_STEP, self.correction_ns), 0))
        return [first, follow_up(FollowUp(self.header(MessageType.FOLLOW_UP, self.log_sync), left_ns))]

    def response(self, request, true_ns, correction_ns=0):
        """Answer to a Delay_Req that arrives at a true time."""
        requester = PortIdentity(int.from_bytes(request[20:28], "big"), int.from_bytes(request[28:30], "big"))
        header = Header(
            MessageType.DELAY_RESP,
            0,
            self.port,
            int.from_bytes(request[30:32], "big"),
            0,
            correction_ns,
            self.log_request,
        )
        return delay_response(DelayResponse(header, true_ns + self.ahead_ns, requester))


class Network:
    """Masters and a slave, joined by a path of `delay_ns` plus up to `noise_ns` in each direction."""

    def __init__(self, *masters, ppm=0.0, delay_ns=20_000, noise_ns=0, seed=1):
        self.masters, self.ppm, self.delay_ns, self.noise_ns = list(masters), ppm, delay_ns, noise_ns
        self.draw = random.Random(seed)
        self.slave = Slave(SLAVE, 0, self.draw.random)
        self.slave.enable()
        self.true_ns = 5 * S
        self.states = []

    def local_ns(self, true_ns):
        return 77 * S + true_ns + round(true_ns * self.ppm * 1e-6)

    def way_ns(self):
        return self.delay_ns + self.draw.randrange(self.noise_ns + 1)

    def run(self, seconds, step_ns=S // 16):
        """Go on for a time; each turn has what is due of every master, then a request of the slave."""
        for _ in range(round(seconds * S / step_ns)):
            self.true_ns += step_ns
            turn = self.true_ns // step_ns
            for master in self.masters:
                self._send(master, turn, step_ns)
            request = self.slave.advance(self.local_ns(self.true_ns))
            if request is not None:
                self._answer(request)
            if not self.states or self.states[-1] != self.slave.state:
                self.states.append(self.slave.state)

    def _send(self, master, turn, step_ns):
        if master.quiet:
            return
        if turn % max(1, round(2.0**master.log_announce * S / step_ns)) == 0:
            self.slave.receive(master.announce(), self.local_ns(self.true_ns))
        if turn % max(1, round(2.0**master.log_sync * S / step_ns)) == 0:
            arrived_ns = self.true_ns + self.way_ns() + master.correction_ns
            for data in master.syncs(self.true_ns):
                self.slave.receive(data, self.local_ns(arrived_ns))

    def _answer(self, request):
        self.slave.sent(self.local_ns(self.true_ns))
        arrived_ns = self.true_ns + self.way_ns()
        for master in self.masters:
            if not master.quiet:
                self.slave.receive(master.response(request, arrived_ns), self.local_ns(arrived_ns + self.delay_ns))

    def error_ns(self, master):
        """True error of the slave's clock now."""
        return self.slave.timebase.at(self.local_ns(self.true_ns)) - (self.true_ns + master.ahead_ns)
