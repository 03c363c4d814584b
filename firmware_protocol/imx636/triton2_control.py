"""The control channel of a Triton2 EVS: requests in, answers out, and orders for the stream.

    host --GVCP--> Control --> Memory --> answer
                      |
                      +--> orders --> Triton2.obey

It imports neither numpy nor the event code, so that a small process can answer at once under any load of the machine.
"""

from __future__ import annotations

import ipaddress
from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from firmware_protocol.gige.control import Control, Datagram, DeviceTime, Order, Owner, Peer, Pulse, TimeSource, Write
from firmware_protocol.gige.gvcp import Action, Refused, Resend, Status
from firmware_protocol.gige.registers import PTP_ON, Memory, Register
from firmware_protocol.imx636.triton2_registers import (
    ACQUISITION_START,
    ACQUISITION_STOP,
    Evs,
    Ptp,
    Triton2Settings,
    triton2_areas,
    triton2_rules,
)
from firmware_protocol.ptp.messages import clock_identity
from firmware_protocol.ptp.slave import PortState, Slave

_LATCH = 1 << 1
_MOST_ORDERS = 4096
_ALWAYS_SLAVE = 1 << 1  # of Ptp.SERVO


@dataclass(frozen=True)
class PtpClock:
    """A clock of the Precision Time Protocol, and the reading of the local clock that it is measured by, ns."""

    slave: Slave
    local_ns: Callable[[], int]

    def now_ns(self) -> int | None:
        """Return the master's time; None if the clock never followed one."""
        timebase = self.slave.timebase
        return None if timebase is None else timebase.at(self.local_ns())


def ptp_identity(settings: Triton2Settings) -> int:
    """Return the identity of a camera's clock, which follows from its MAC."""
    registers = triton2_areas(settings)[0]
    return clock_identity(int.from_bytes(registers[Register.MAC_HIGH : Register.MAC_LOW + 4], "big") & (1 << 48) - 1)


class Triton2Control:
    """Control channel of one camera: answers hosts and queues orders.

    Parameters
    ----------
    time : source of the device's clock, as the stream has it.
    stream_port : port from which the stream is sent.
    ptp : clock that a host can switch on, if the settings have `ptp`.

    Attributes
    ----------
    orders : Orders that the stream is to execute next; the caller takes them from the left. When the queue is full,
        further requests that would give an order are refused as busy.
    """

    def __init__(
        self, settings: Triton2Settings, time: TimeSource, stream_port: int = 0, ptp: PtpClock | None = None
    ) -> None:
        self._memory = Memory(triton2_areas(settings), triton2_rules(settings))
        self._ptp = ptp
        self._latch_ptp()
        self._memory.set(Register.STREAM_SOURCE_PORT, stream_port)
        self._control = Control(self._memory, self)
        self._time = time
        self._starts = 0
        self._acquiring = False
        self.orders: deque[Order] = deque()

    def receive(self, datagrams: Sequence[Datagram], now_ns: int) -> list[Datagram]:
        """Return the answers to datagrams of the control port; `now_ns` counts the heartbeat."""
        if self._ptp is not None:
            self._memory.set(Register.PTP_STATE, self._ptp.slave.state)
        answers = self._control.take(datagrams, now_ns)
        self._control.expire(now_ns)
        return answers

    def release(self) -> None:
        """Withdraw control from the host that has it, as after a missed heartbeat."""
        self._control.release()

    def move(self, address: str, stream_port: int) -> None:
        """Report another address from now on, and another port from which the stream is sent."""
        self._memory.set(Register.ADDRESS, int(ipaddress.IPv4Address(address)))
        self._memory.set(Register.STREAM_SOURCE_PORT, stream_port)

    @property
    def owner(self) -> Peer | None:
        """The host that has control."""
        return self._control.owner

    @property
    def counts(self) -> Counter[str]:
        """Requests by outcome."""
        return self._control.counts

    def check_room(self) -> None:
        """Refuse a request while too many orders wait for the camera."""
        if len(self.orders) >= _MOST_ORDERS:
            raise Refused(Status.BUSY)

    def wrote(self, address: int, value: int) -> None:
        """Follow a written register, and pass it on to the camera."""
        if address == ACQUISITION_START and value and not self._acquiring:
            self._acquiring = True
            self._starts += 1
        elif address == ACQUISITION_STOP and value:
            self._acquiring = False
        elif address == Register.TIME_CONTROL and value & _LATCH:
            time_ns = self._now_ns()  # without a master, the clock is set to zero by AcquisitionStart alone
            self._memory.set(Register.TIME_HIGH, time_ns >> 32)
            self._memory.set(Register.TIME_LOW, time_ns & 0xFFFFFFFF)
        elif address == Register.GVCP_CONFIGURATION and self._ptp is not None:
            self._turn_ptp(self._ptp.slave, bool(value & PTP_ON))
        elif address == Ptp.LATCH:
            self._latch_ptp()
        self.orders.append(Write(address, value))

    def taken(self, peer: Peer) -> None:
        """Pass the new owner on to the camera."""
        self.orders.append(Owner(peer))

    def released(self) -> None:
        """Stop the stream: its owner is gone."""
        self._acquiring = False
        self._memory.set(Evs.EVENT_NOTIFICATION, 0)
        self.orders.append(Owner(None))

    def resend(self, request: Resend) -> None:
        """Pass the request for packets on to the camera."""
        self.orders.append(request)

    def act(self, action: Action) -> Status:
        """Order a pulse on the trigger input; one that is late is executed at once."""
        late = action.time_ns is not None and action.time_ns <= self._now_ns()
        self.orders.append(Pulse(None if late else action.time_ns))
        return Status.ACTION_LATE if late else Status.SUCCESS

    def _turn_ptp(self, slave: Slave, on: bool) -> None:
        """Switch the clock on or off; it is on already if a host writes another bit of the register."""
        if on and slave.state == PortState.DISABLED:
            slave.enable()
        elif not on:
            slave.disable()

    def _latch_ptp(self) -> None:
        """Store the data sets of the clock."""
        if self._ptp is None:
            return
        status = self._ptp.slave.status
        self._memory.set(Ptp.STATE, status.state)
        self._memory.set(Ptp.SERVO, _ALWAYS_SLAVE | status.locked)
        for register, value in (
            (Ptp.OFFSET, status.offset_ns), (Ptp.DELAY, status.delay_ns), (Ptp.CLOCK, status.clock),
            (Ptp.PARENT, status.parent), (Ptp.GRANDMASTER, status.grandmaster),
        ):  # fmt: skip
            self._memory.set(register, value >> 32)
            self._memory.set(register + 4, value)

    def _now_ns(self) -> int:
        """Return the master's time if there is one, or the device's clock: zero until the stream has begun."""
        master_ns = None if self._ptp is None else self._ptp.now_ns()
        if master_ns is not None:
            return max(0, master_ns)
        time: DeviceTime = self._time()
        return time.ns if time.starts == self._starts else 0
