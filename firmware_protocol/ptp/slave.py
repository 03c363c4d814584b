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

The clock is one in software, `Timebase`; a servo sets its time and rate by the measured offsets from the master.

    time = time_ns + (local - local_ns) * (1 + rate_ppb / 10^9)        in integers, rounded down

`local` is a free-running clock of the machine, which is never set.

The servo has three phases:

    first offset         the time is set by all of it
    estimate             at least 8 offsets and 1 s: the rate is set by the line through the medians of both halves
    locked               rate -= proportional * offset + integral, limited; phase error decays with damping 0.7

An offset beyond 1 ms, three times in a row, begins anew: the master has set its time. In the locked phase a single
offset counts for at most 100 us, so that one late message does not move the clock.
"""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import IntEnum

from firmware_protocol.ptp.messages import (
    NO_INTERVAL,
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

_PPB = 1_000_000_000
_NS_PER_S = 1_000_000_000
_MOST_PPB = 500_000
_STEP_NS = 1_000_000
_STEPS_IN_A_ROW = 3
_MOST_COUNTED_NS = 100_000
_LEAST_ESTIMATES = 8
_ESTIMATE_NS = 1_000_000_000
_PROPORTIONAL, _INTEGRAL = 0.2, 0.02  # of an offset, in one interval
_INTERVALS_S = (1 / 128, 64.0)


@dataclass(frozen=True)
class Timebase:
    """Relation of a clock to the local one.

    Attributes
    ----------
    local_ns, time_ns : readings of the local clock and of this one at the same instant.
    rate_ppb : parts in 10^9 by which this clock goes faster than the local one.
    """

    local_ns: int = 0
    time_ns: int = 0
    rate_ppb: int = 0

    def at(self, local_ns: int) -> int:
        """Return the clock's reading at a reading of the local clock, ns."""
        elapsed_ns = local_ns - self.local_ns
        return self.time_ns + elapsed_ns + elapsed_ns * self.rate_ppb // _PPB

    def slewed(self, local_ns: int, rate_ppb: int) -> Timebase:
        """Return the clock with another rate from `local_ns` on."""
        return Timebase(local_ns, self.at(local_ns), rate_ppb)

    def stepped(self, by_ns: int) -> Timebase:
        """Return the clock with its time set ahead by `by_ns`."""
        return replace(self, time_ns=self.time_ns + by_ns)


class Servo:
    """The servo of one clock.

    Attributes
    ----------
    clock : the clock that it sets.
    locked : True if time and rate follow the master.
    steps : number of times that the time was set.
    """

    def __init__(self) -> None:
        self.clock = Timebase()
        self.steps = 0
        self.locked = False
        self._samples: list[tuple[int, int]] = []
        self._far = 0
        self._integral_ppb = 0.0
        self._before_s = 0.0
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Begin anew with the next offset; until then the clock goes on with its rate."""
        self.locked = False
        self._samples.clear()
        self._far = 0
        self._before_s = 0.0
        self._last_ns = None

    def sample(self, local_ns: int, offset_ns: int) -> None:
        """Take an offset of the clock from its master, measured at `local_ns`."""
        if self._last_ns is not None and local_ns <= self._last_ns:
            return
        if self._last_ns is None:
            self._set(-offset_ns)
        elif self.locked and self._is_far(offset_ns):
            self.restart()
            self._set(-offset_ns)
        elif self.locked:
            self._follow(local_ns, offset_ns)
        else:
            self._estimate(local_ns, offset_ns)
        self._last_ns = local_ns

    def _set(self, by_ns: int) -> None:
        self.clock = self.clock.stepped(by_ns)
        self.steps += 1

    def _is_far(self, offset_ns: int) -> bool:
        self._far = self._far + 1 if abs(offset_ns) > _STEP_NS else 0
        return self._far == _STEPS_IN_A_ROW

    def _estimate(self, local_ns: int, offset_ns: int) -> None:
        """Collect offsets; then set rate and time by them."""
        self._samples.append((local_ns, offset_ns))
        if len(self._samples) < _LEAST_ESTIMATES or local_ns - self._samples[0][0] < _ESTIMATE_NS:
            return
        slope_ppb, last_ns = _line(self._samples)
        self._integral_ppb = _limited(self.clock.rate_ppb - slope_ppb)
        self.clock = self.clock.slewed(local_ns, round(self._integral_ppb))
        self._set(-round(last_ns))
        self.locked = True
        self._samples.clear()

    def _follow(self, local_ns: int, offset_ns: int) -> None:
        assert self._last_ns is not None
        least_s, most_s = _INTERVALS_S
        elapsed_s = min(most_s, max(least_s, (local_ns - self._last_ns) / _NS_PER_S))
        interval_s = max(elapsed_s, self._before_s)  # a Sync that came late is followed by the next one soon
        self._before_s = elapsed_s
        counted_ns = min(_MOST_COUNTED_NS, max(-_MOST_COUNTED_NS, offset_ns))
        self._integral_ppb = _limited(self._integral_ppb - _INTEGRAL * counted_ns / interval_s)
        rate_ppb = _limited(self._integral_ppb - _PROPORTIONAL * counted_ns / interval_s)
        self.clock = self.clock.slewed(local_ns, round(rate_ppb))


def _line(samples: list[tuple[int, int]]) -> tuple[float, float]:
    """Return slope, ns/s, and last value, ns, of the line through both halves' medians; one outlier has no effect."""
    times_s = [(local_ns - samples[0][0]) / _NS_PER_S for local_ns, _ in samples]
    offsets_ns = [offset_ns for _, offset_ns in samples]
    half = len(samples) // 2
    first_s, second_s = middle(times_s[:half]), middle(times_s[half:])
    first_ns, second_ns = middle(offsets_ns[:half]), middle(offsets_ns[half:])
    slope = (second_ns - first_ns) / (second_s - first_s)
    return slope, second_ns + slope * (times_s[-1] - second_s)


def middle(values: Sequence[float]) -> float:
    """Return the median; `statistics` takes longer to import than a small process should need."""
    ordered = sorted(values)
    return (ordered[(len(ordered) - 1) // 2] + ordered[len(ordered) // 2]) / 2


def _limited(rate_ppb: float) -> float:
    return min(_MOST_PPB, max(-_MOST_PPB, rate_ppb))


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
    offset_ns : last measured offset of the clock from its master.
    delay_ns : delay of the path in one direction.
    clock, parent, grandmaster : identities of this clock, its master, and that one's grandmaster; 0: none.
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
    clock : identity of the clock, 64 bits.
    domain : domain of the protocol; messages of others are ignored.
    draw : source of numbers from 0 to 1, evenly distributed, for the pauses between requests.

    Attributes
    ----------
    state : state of the port.
    counts : messages by what became of them.
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
        master = self._masters.get(source)
        if master is None:
            if len(self._masters) == _MOST_MASTERS:
                self.counts["ptp messages ignored"] += 1
                return
            self._masters[source] = _Master(message, local_ns)
        else:
            master.before_ns = master.last_ns
            master.last_ns = local_ns
            master.announce = message
        self._choose(local_ns)

    def _choose(self, local_ns: int) -> None:
        """Follow the best master."""
        good = [
            master
            for source, master in self._masters.items()
            if source == self._parent or master.is_qualified(local_ns)
        ]
        best = min(good, key=lambda master: master.announce.rank, default=None)
        if best is None or best.announce.header.source == self._parent:
            return
        self._parent = best.announce.header.source
        self._unpair()
        self.state = PortState.UNCALIBRATED
        self.counts["ptp masters chosen"] += 1

    def _expire(self, local_ns: int) -> None:
        """Forget masters that no longer announce themselves."""
        for source, master in list(self._masters.items()):
            intervals = _TIMEOUT_INTERVALS if source == self._parent else _WINDOW_INTERVALS
            if local_ns - master.last_ns <= intervals * master.interval_ns:
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
            case Sync() if not message.header.flags & Flag.TWO_STEP:
                self._measure(message, message.time_ns, message.header.correction_ns, local_ns)
            case Sync():
                self._sync = message, local_ns
                if self._follow_up is not None:  # it is of another port, and can be read before its Sync
                    self._followed(self._follow_up)
            case FollowUp():
                self._followed(message)
            case DelayResponse():
                self._responded(message)

    def _followed(self, message: FollowUp) -> None:
        if self._sync is None or self._sync[0].header.sequence != message.header.sequence:
            self._follow_up = message
            return
        sync, local_ns = self._sync
        self._sync = self._follow_up = None
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
    if log_interval == NO_INTERVAL:
        return _NS_PER_S
    least, greatest = _LOG_INTERVALS
    return round(2.0 ** min(greatest, max(least, log_interval)) * _NS_PER_S)
