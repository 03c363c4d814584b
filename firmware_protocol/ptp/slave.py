"""An ordinary clock of the Precision Time Protocol that is only a slave: messages in, delay requests out, no I/O.

    INITIALIZING --> LISTENING --two Announce of a master--> UNCALIBRATED --servo locked--> SLAVE
                        ^                                         |                           |
                        +------------- the master's Announce stop for three intervals --------+
    any --a socket fails--> FAULTY --cleared--> INITIALIZING           any --disabled--> DISABLED

Of the masters with two Announce within four intervals the best is followed: see `Announce.rank`. The end-to-end
mechanism measures the delay of the path:

    master  t1 ----Sync----> t2  slave         offset of the slave = t2 - t1 - correction - delay
    master  t4 <-Delay_Req-- t3  slave         delay = ((t2 - t1 - correction) + (t4 - t3 - correction)) / 2

t2 and t3 are read on the clock that is set; the delay is the median of the last ten. Without a master the clock goes
on with the last rate.

All of it is bounded: five masters, one Sync, one Follow_Up and one Delay_Req that wait.

Source: IEEE 1588-2019, sections 9 and 11, as implemented in the open by linuxptp. Masters are compared by one key; the
standard compares by steps before quality if two announce one grandmaster, which a single key cannot.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

from firmware_protocol.ptp.clock import Servo, Timebase, middle
from firmware_protocol.ptp.messages import (
    Announce,
    DelayResponse,
    Flag,
    FollowUp,
    Message,
    PortIdentity,
    Sync,
    delay_request,
    parse,
)

_NS_PER_S = 1_000_000_000
_LOG_INTERVALS = (-4, 6)
_TIMEOUT_INTERVALS = 3
_WINDOW_INTERVALS = 4
_MOST_MASTERS = 5
_MOST_STEPS = 255
_DELAYS = 10
_DELAY_BOUNDS_NS = (-1_000_000, _NS_PER_S)  # of a path; software stamps can make a short one negative


class PortState(IntEnum):
    """States of a port, as in the standard; a slave is never in those that are missing."""

    INITIALIZING = 1
    FAULTY = 2
    DISABLED = 3
    LISTENING = 4
    UNCALIBRATED = 8
    SLAVE = 9


@dataclass(frozen=True)
class PtpStatus:
    """Data sets of the clock, as a host latches them.

    Attributes
    ----------
    offset_ns
        Last measured offset of the clock from its master.
    delay_ns
        Delay of the path in one direction.
    clock, parent, grandmaster
        Identities of this clock, its master, and that one's grandmaster; 0: none.
    """

    state: PortState = PortState.DISABLED
    locked: bool = False
    offset_ns: int = 0
    delay_ns: int = 0
    clock: int = 0
    parent: int = 0
    grandmaster: int = 0


@dataclass
class _Master:
    announce: Announce
    last_ns: int
    before_ns: int | None = None

    @property
    def interval_ns(self) -> int:
        return _interval_ns(self.announce.header.log_interval)

    def is_qualified(self, now_ns: int) -> bool:
        return self.before_ns is not None and now_ns - self.before_ns <= _WINDOW_INTERVALS * self.interval_ns


@dataclass
class _Request:
    sequence: int
    sent_ns: int | None = None


class Slave:
    """The clock of one port.

    Parameters
    ----------
    clock
        Identity of the clock, 64 bits.
    domain
        Domain of the protocol; messages of others are ignored.
    draw
        Source of numbers from 0 to 1, evenly distributed, for the pauses between requests.

    Attributes
    ----------
    state
        State of the port.
    counts
        Messages by what became of them.
    """

    def __init__(self, clock: int, domain: int, draw: Callable[[], float]) -> None:
        self._port = PortIdentity(clock, 1)
        self._domain = domain
        self._draw = draw
        self._servo = Servo()
        self.state = PortState.DISABLED
        self.counts: Counter[str] = Counter()
        self._sequence = 0
        self._offset_ns = 0
        self._is_synchronized = False
        self._forget()

    def _forget(self) -> None:
        """Forget all masters."""
        self._masters: dict[PortIdentity, _Master] = {}
        self._parent: PortIdentity | None = None
        self._unpair()

    def _unpair(self) -> None:
        """Forget what was measured with the last master."""
        self._sync: tuple[Sync, int] | None = None
        self._follow_up: FollowUp | None = None
        self._one_way_ns: int | None = None
        self._delays_ns: deque[int] = deque(maxlen=_DELAYS)
        self._request: _Request | None = None
        self._next_request_ns: int | None = None
        self._request_interval_ns = _NS_PER_S
        self._servo.restart()

    @property
    def timebase(self) -> Timebase | None:
        """The clock; None before it first followed a master, and while the protocol is disabled."""
        return self._servo.clock if self._is_synchronized else None

    @property
    def status(self) -> PtpStatus:
        """The data sets."""
        master = None if self._parent is None else self._masters[self._parent].announce
        ids = (0, 0) if master is None else (master.header.source.clock, master.grandmaster)
        return PtpStatus(self.state, self._servo.locked, self._offset_ns, self._delay_ns, self._port.clock, *ids)

    @property
    def _delay_ns(self) -> int:
        return round(middle(self._delays_ns)) if self._delays_ns else 0

    def enable(self) -> None:
        """Begin; without effect if the protocol is enabled already and has no fault."""
        if self.state in (PortState.DISABLED, PortState.FAULTY):
            self._forget()
            self.state = PortState.INITIALIZING

    def disable(self) -> None:
        """End: the clock no longer has a master's time."""
        self._forget()
        self._is_synchronized = False
        self._offset_ns = 0
        self.state = PortState.DISABLED

    def fail(self) -> None:
        """Note that messages cannot be sent or received; `enable` clears the fault."""
        self._forget()
        self.state = PortState.FAULTY

    def receive(self, data: bytes, local_ns: int) -> None:
        """Process a datagram that arrived at `local_ns`, a reading of the local clock."""
        if self.state in (PortState.DISABLED, PortState.FAULTY):
            return
        message = parse(data)
        if message is None or message.header.domain != self._domain or message.header.source.clock == self._port.clock:
            self.counts["ptp messages ignored"] += 1
        elif isinstance(message, Announce):
            self._announced(message, local_ns)
        elif message.header.source == self._parent:
            self._timed(message, local_ns)

    def advance(self, local_ns: int) -> bytes | None:
        """Set the local clock's time; return a Delay_Req that is to leave now, or None."""
        if self.state == PortState.INITIALIZING:
            self.state = PortState.LISTENING
        self._expire(local_ns)
        if self._next_request_ns is None or local_ns < self._next_request_ns:
            return None
        self._sequence = (self._sequence + 1) & 0xFFFF
        self._request = _Request(self._sequence)
        self._next_request_ns = local_ns + round(2 * self._draw() * self._request_interval_ns)
        self.counts["ptp delay requests"] += 1
        return delay_request(self._port, self._sequence, self._domain)

    def sent(self, local_ns: int) -> None:
        """Take the time at which the last Delay_Req left, by the local clock."""
        if self._request is not None and self._request.sent_ns is None:
            self._request.sent_ns = local_ns

    def _announced(self, message: Announce, local_ns: int) -> None:
        source = message.header.source
        if message.header.flags & Flag.ALTERNATE_MASTER or message.steps_removed >= _MOST_STEPS:
            self.counts["ptp messages ignored"] += 1
            return
        known = self._masters.get(source)
        if known is None:
            if len(self._masters) == _MOST_MASTERS:
                self.counts["ptp messages ignored"] += 1
                return
            self._masters[source] = _Master(message, local_ns)
        else:
            known.announce, known.before_ns, known.last_ns = message, known.last_ns, local_ns
        self._choose(local_ns)

    def _choose(self, local_ns: int) -> None:
        """Follow the best master."""
        good = [one for source, one in self._masters.items() if source == self._parent or one.is_qualified(local_ns)]
        best = min(good, key=lambda one: one.announce.rank, default=None)
        if best is None or best.announce.header.source == self._parent:
            return
        self._parent = best.announce.header.source
        self._unpair()
        self.state = PortState.UNCALIBRATED
        self.counts["ptp masters chosen"] += 1

    def _expire(self, local_ns: int) -> None:
        """Forget masters that no longer announce themselves."""
        for source, one in list(self._masters.items()):
            intervals = _TIMEOUT_INTERVALS if source == self._parent else _WINDOW_INTERVALS
            if local_ns - one.last_ns <= intervals * one.interval_ns:
                continue
            del self._masters[source]
            if source == self._parent:
                self._parent = None
                self._unpair()
                self.state = PortState.LISTENING
                self.counts["ptp masters lost"] += 1
                self._choose(local_ns)

    def _timed(self, message: Message, local_ns: int) -> None:
        match message:
            case Sync():
                self._synced(message, local_ns)
            case FollowUp():
                self._followed(message)
            case DelayResponse():
                self._responded(message)

    def _synced(self, message: Sync, local_ns: int) -> None:
        if not message.header.flags & Flag.TWO_STEP:
            self._measure(message, message.time_ns, message.header.correction_ns, local_ns)
            return
        self._sync = message, local_ns
        if self._follow_up is not None:  # it is of another port, and can be read before its Sync
            self._followed(self._follow_up)

    def _followed(self, message: FollowUp) -> None:
        if self._sync is None or self._sync[0].header.sequence != message.header.sequence:
            self._follow_up = message
            return
        (sync, local_ns), self._sync, self._follow_up = self._sync, None, None
        self._measure(sync, message.time_ns, sync.header.correction_ns + message.header.correction_ns, local_ns)

    def _measure(self, sync: Sync, left_ns: int, correction_ns: int, local_ns: int) -> None:
        """Take the times of a Sync."""
        self.counts["ptp syncs measured"] += 1
        self._one_way_ns = self._servo.clock.at(local_ns) - left_ns - correction_ns
        if self._next_request_ns is None:
            self._next_request_ns = local_ns
        if not self._delays_ns:
            return
        self._offset_ns = self._one_way_ns - self._delay_ns
        steps, was_locked = self._servo.steps, self._servo.locked
        self._servo.sample(local_ns, self._offset_ns)
        if self._servo.steps != steps:  # times before do not fit those after
            self._one_way_ns = self._request = None
            self.counts["ptp clock set"] += 1
        if self._servo.locked and not was_locked:  # measured with another rate
            self._delays_ns.clear()
            return
        self.state = PortState.SLAVE if self._servo.locked else PortState.UNCALIBRATED
        self._is_synchronized |= self._servo.locked

    def _responded(self, message: DelayResponse) -> None:
        request = self._request
        if message.requester != self._port or request is None or request.sequence != message.header.sequence:
            return
        self._request_interval_ns = _interval_ns(message.header.log_interval)
        if request.sent_ns is None or self._one_way_ns is None:
            return
        self._request = None
        back_ns = message.time_ns - message.header.correction_ns - self._servo.clock.at(request.sent_ns)
        delay_ns = (self._one_way_ns + back_ns) // 2
        if _DELAY_BOUNDS_NS[0] <= delay_ns <= _DELAY_BOUNDS_NS[1]:
            self._delays_ns.append(delay_ns)
        else:
            self.counts["ptp delays out of bounds"] += 1


def _interval_ns(log_interval: int) -> int:
    """Return an interval of the header, limited; that of a message without one is a second."""
    if log_interval == 127:
        return _NS_PER_S
    least, most = _LOG_INTERVALS
    return round(2.0 ** min(most, max(least, log_interval)) * _NS_PER_S)
