"""The arbiter as read-out, which turns requests of pixels into events on the output bus; and the jitter of events.

A pixel that fires raises a request until the arbiter serves it. A crossing of a pixel whose request still waits is
lost, and counted. Whenever the arbiter is free and a request waits, it takes three steps:

    pick     select the next row with requests, round-robin from the row after the one served last
    latch    row_ns later: take all requests of that row at that moment; their pixels are free again
    send     send these by rising column, one each event_ns; an event is stamped when it leaves

Then it is free again. A decision at time T uses the requests raised up to and including T only, so the result does not
depend on how crossings are divided over calls of `push`. No row is served twice while another waits (the
arbiter is not greedy, Lichtsteiner et al. 2008), and the bus sends at most 1 / event_ns.

The comparator of a waiting pixel stays in reset until its request is served, the acknowledge, and the refractory period
begins there. Here the pixel continues as if it were served at once, and only its events are lost: those of a pixel
whose request waits and, with `reset.at_acknowledge`, those before the end of a refractory period after it. The pixel's
reference is then that of the last event that it lost, or older; a real one's is the signal at the end of its reset.
They differ by less than a threshold, since a larger difference would have raised one more event.

The cost is linear in the events: requests and rows are bit maps, 64 to a word, without sorting or searching by event.
A crossing that finds no other request is served without them, and of a row only the words with requests are visited.

Jitter is a keyed delay for each event of each pixel, which preserves the order of a pixel's events. Event number k of a
pixel (counted since the reset) is delayed by a log-normal time of the given mean and deviation, keyed by pixel and k,
and a share of the events by an exponential time more; it leaves at least 1 ns after event k - 1. Events that leave
after the step stay pending. So the result depends on the crossings alone, not on their division into steps.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.chip.sources import LONGEST_NS, Pending, Window, new_pending, release, reserve
from emulator.sensor.numerics.compiled import NONE, cached_entry, kernel, lane, log_compilation
from emulator.sensor.numerics.elementary import lowest_bit
from emulator.sensor.numerics.keyed import Purpose, high, low, normal_from, root_of, stream, unit, word
from emulator.sensor.parameters import JitterParameters
from emulator.sensor.pixels.crossings import NO_CROSSINGS, Crossings, joined, unpacked
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import EVENT, Events, Int64s, Mask, copy_events

_FOREVER_NS = (1 << 63) - 1

_Words = npt.NDArray[np.uint64]

# Phases of the arbiter.
_IDLE, _PICKED, _SENDING = range(3)


class _Maps(NamedTuple):
    """Requests, as bit maps: 64 pixels of a row to a word."""

    waiting: _Words  # (height, words), bit set: this pixel holds a request
    polarity: _Words  # (height, words), of those requests
    rows: _Words  # bit set: this row has requests
    counts: Int64s  # (height,), requests in each row
    filled: _Words  # (height,), bit set: this group of the row's words has requests
    latched: _Words  # (words,), the words with requests of the row being sent, not yet sent, without gaps
    latched_polarity: _Words
    latched_words: Int64s  # their numbers in the row
    busy_until_ns: Int64s  # (pixels,), end of the refractory period after the acknowledge; empty where it is not used


class Arrivals(NamedTuple):
    """Crossings, as in `Crossings`."""

    t_ns: Int64s
    pixel: npt.NDArray[np.uint32]
    on: Mask


class _Timing(NamedTuple):
    width: int
    row_ns: int
    event_ps: int
    group_bits: int  # words of a group, as a power of two: a row has at most 64 groups
    refractory_ns: int  # after the acknowledge


class _Queue(NamedTuple):
    """Number of waiting requests, time of the first of them, row of the latest one, and numbers of lost ones.

    `busy` are those of pixels in the refractory period after the acknowledge, `lost` of pixels whose request waits.
    """

    waiting: int
    ready_ns: int
    row: int
    lost: int
    busy: int


class _Arbiter(NamedTuple):
    """The state of the arbiter beside the queue."""

    phase: int
    free_ns: int  # start of the idle phase
    row: int  # picked, being sent, or last sent
    latch_ns: int
    latched: int  # events of the row
    sent: int  # of them
    word: int  # latched word of the next event


@lane
def _admit(
    arrivals: Arrivals, k: int, until_ns: int, maps: _Maps, timing: _Timing, queue: _Queue
) -> tuple[int, _Queue]:
    """Turn crossings from k on, up to and including `until_ns`, into requests; return the next k and the queue."""
    waiting, ready_ns, latest, lost, busy = queue
    while k < arrivals.t_ns.size and arrivals.t_ns[k] <= until_ns:
        pixel = np.uint64(arrivals.pixel[k])
        row = int(np.int64(pixel // np.uint64(timing.width)))
        x = np.int64(pixel) - row * timing.width
        word, place = x >> 6, np.uint64(x & 63)
        bit = np.uint64(1) << place
        if maps.waiting[row, word] & bit:
            lost += 1
        elif maps.busy_until_ns.size > 0 and arrivals.t_ns[k] < maps.busy_until_ns[pixel]:
            busy += 1
        else:
            ready_ns = ready_ns if waiting else arrivals.t_ns[k]
            waiting += 1
            latest = row
            maps.waiting[row, word] |= bit
            maps.polarity[row, word] |= np.uint64(arrivals.on[k]) << place
            maps.rows[row >> 6] |= np.uint64(1) << np.uint64(row & 63)
            maps.counts[row] += 1
            maps.filled[row] |= np.uint64(1) << np.uint64(word >> timing.group_bits)
        k += 1
    return k, _Queue(waiting, ready_ns, latest, lost, busy)


@lane
def _next_row(rows: _Words, last: int, height: int) -> int:
    """Return the first row with requests after `last`, round-robin; at least one row has requests."""
    first = last + 1 if last + 1 < height else 0
    word = first >> 6
    bits = rows[word] & (~np.uint64(0) << np.uint64(first & 63))
    while bits == 0:
        word = word + 1 if word + 1 < rows.size else 0
        bits = rows[word]
    return int(word * 64 + np.int64(lowest_bit(bits)))


@lane
def _latch(maps: _Maps, row: int, group_bits: int) -> int:
    """Take all requests of a row, and return their number; only words with requests are visited."""
    m, groups = NONE, maps.filled[row]
    while groups != 0:
        first = np.int64(lowest_bit(groups)) << group_bits
        for number in range(first, min(first + (np.int64(1) << group_bits), maps.waiting.shape[1])):
            if maps.waiting[row, number] != 0:
                maps.latched[m], maps.latched_words[m] = maps.waiting[row, number], number
                maps.latched_polarity[m] = maps.polarity[row, number]
                maps.waiting[row, number] = maps.polarity[row, number] = np.uint64(0)
                m += 1
        groups &= groups - np.uint64(1)
    maps.rows[row >> 6] &= ~(np.uint64(1) << np.uint64(row & 63))
    n = maps.counts[row]
    maps.counts[row], maps.filled[row] = 0, np.uint64(0)
    return int(n)


@lane
def _acknowledge(maps: _Maps, row: int, events: int, width: int, until_ns: int) -> None:
    """Note the end of the refractory period of the pixels of a row that were latched just now."""
    word = marked = NONE
    while marked < events:
        bits = maps.latched[word]
        while bits != 0:
            maps.busy_until_ns[row * width + maps.latched_words[word] * 64 + np.int64(lowest_bit(bits))] = until_ns
            bits &= bits - np.uint64(1)
            marked += 1
        word += 1


@lane
def _send(maps: _Maps, a: _Arbiter, event_ps: int, until_ns: int, out: Events, n: int) -> tuple[int, _Arbiter]:
    """Send latched events that leave before `until_ns`, into `out` from n on; return the new n and the arbiter."""
    sent, word = a.sent, a.word
    exit_ns = a.free_ns
    while sent < a.latched:
        leaves_ns = a.latch_ns + ((sent + 1) * event_ps + 999) // 1000
        if leaves_ns >= until_ns:
            break
        exit_ns = leaves_ns
        bits = maps.latched[word]
        x, left = lowest_bit(bits), bits & (bits - np.uint64(1))
        event = out[n]
        event.t = exit_ns // 1000
        event.x = maps.latched_words[word] * 64 + np.int64(x)
        event.y = a.row
        event.on = (maps.latched_polarity[word] >> x) & np.uint64(1) != 0
        maps.latched[word] = left
        word += left == 0
        n += 1
        sent += 1
    phase = _SENDING if sent < a.latched else _IDLE
    return n, _Arbiter(phase, exit_ns, a.row, a.latch_ns, a.latched, sent, word)


@kernel
def _serve_lone(
    arrivals: Arrivals, k: int, until_ns: int, timing: _Timing, a: _Arbiter, out: Events, n: int
) -> tuple[int, int, _Arbiter]:
    """Serve crossings from k on while each is latched before the next one comes, into `out` from n on.

    For an idle arbiter without requests: they need no bit maps. Returns the new n and k, and the arbiter.
    """
    free_ns, row = a.free_ns, a.row
    send_ns = (timing.event_ps + 999) // 1000
    while k < arrivals.t_ns.size:
        latch_ns = max(free_ns, arrivals.t_ns[k]) + timing.row_ns
        is_last = k + 1 == arrivals.t_ns.size
        if latch_ns + send_ns >= until_ns or not (is_last or arrivals.t_ns[k + 1] > latch_ns):
            break
        pixel = np.uint64(arrivals.pixel[k])
        row = int(np.int64(pixel // np.uint64(timing.width)))
        free_ns = latch_ns + send_ns
        event = out[n]
        event.t = free_ns // 1000
        event.x = np.int64(pixel) - row * timing.width
        event.y = row
        event.on = arrivals.on[k]
        n, k = n + 1, k + 1
    return n, k, _Arbiter(_IDLE, free_ns, row, 0, 0, 0, 0)


@kernel
def _run(
    arrivals: Arrivals, until_ns: int, maps: _Maps, queue: _Queue, a: _Arbiter, timing: _Timing, out: Events
) -> tuple[int, _Queue, _Arbiter]:
    """Run the arbiter until `until_ns`; return the number of events written to `out`, the queue and the arbiter."""
    n = k = NONE
    while True:
        if a.phase == _SENDING:
            n, a = _send(maps, a, timing.event_ps, until_ns, out, n)
            if a.phase == _SENDING:
                break
        if a.phase == _IDLE:
            if queue.waiting == 0 and maps.busy_until_ns.size == 0:
                n, k, a = _serve_lone(arrivals, k, until_ns, timing, a, out, n)
            if queue.waiting == 0 and k == arrivals.t_ns.size:
                break
            first_ns = queue.ready_ns if queue.waiting else arrivals.t_ns[k]
            start_ns = max(a.free_ns, first_ns)
            if start_ns >= until_ns:
                break
            k, queue = _admit(arrivals, k, start_ns, maps, timing, queue)
            if queue.waiting == 0:
                continue  # all of them were those of busy pixels
            lone = queue.waiting == 1 and maps.counts[queue.row] == 1
            row = queue.row if lone else _next_row(maps.rows, a.row, maps.counts.size)
            a = _Arbiter(_PICKED, a.free_ns, row, start_ns + timing.row_ns, 0, 0, 0)
        if a.latch_ns >= until_ns:
            break
        k, queue = _admit(arrivals, k, a.latch_ns, maps, timing, queue)
        taken = _latch(maps, a.row, timing.group_bits)
        if maps.busy_until_ns.size > 0:
            _acknowledge(maps, a.row, taken, timing.width, a.latch_ns + timing.refractory_ns)
        queue = _Queue(queue.waiting - taken, queue.ready_ns, queue.row, queue.lost, queue.busy)
        a = _Arbiter(_SENDING, a.free_ns, a.row, a.latch_ns, taken, 0, 0)
    _, queue = _admit(arrivals, k, np.int64(_FOREVER_NS), maps, timing, queue)
    return n, queue, a


@cached_entry
def _serve(
    arrivals: Arrivals, until_ns: int, maps: _Maps, queue: _Queue, a: _Arbiter, timing: _Timing, out: Events
) -> tuple[int, tuple[int, ...], tuple[int, ...]]:
    """Run the arbiter as `_run` does; this entry is cached on disk."""
    n, queue, a = _run(arrivals, until_ns, maps, queue, a, timing, out)
    return n, queue[0:], a[0:]


class ReadOut(ABC):
    """The read-out of one sensor: crossings in, events out, in the order in which they leave.

    Attributes
    ----------
    raised : crossings pushed; always lost_at_readout + read_out + pending.
    read_out : events returned.
    """

    _timing: Any
    _queue: Any  # with the numbers of waiting requests and of those lost

    def __init__(self) -> None:
        self._until_ns = -_FOREVER_NS
        self._out = np.empty(0, EVENT)
        self.raised = 0
        self.read_out = 0

    @property
    def lost_at_readout(self) -> int:
        """Crossings of pixels whose request still waited, or that were busy after their acknowledge."""
        return int(self._queue.lost + self._queue.busy)

    @property
    def pending(self) -> int:
        """Requests that wait, and events that have not left."""
        return int(self._queue.waiting)

    def set_refractory(self, refractory_us: float) -> None:
        """Set the refractory period after an acknowledge from now on; those that have begun end at their time."""
        self._timing = self._timing._replace(refractory_ns=round(refractory_us * 1000))

    def push(self, crossings: Crossings, until_ns: int) -> Events:
        """Add crossings, and return the events that leave before `until_ns`; raises ValueError if time goes back.

        These are (n,) EVENT, sorted by t, which is the time of leaving in us, rounded down.

        Parameters
        ----------
        crossings : sorted by time, none before the last `until_ns` and none after this one.
        until_ns : stream time up to which all crossings are known.
        """
        t_ns = crossings.t_ns
        if until_ns < self._until_ns:
            raise ValueError(f"until_ns = {until_ns}: before the last one, {self._until_ns}; time does not go back")
        if t_ns.size and (t_ns[0] < self._until_ns or t_ns[-1] > until_ns):
            raise ValueError(
                f"crossings from {t_ns[0]} to {t_ns[-1]} ns: must lie from {self._until_ns} to {until_ns} ns"
            )
        self.raised += len(crossings)
        self._until_ns = until_ns
        room = self.pending + len(crossings)
        if room > self._out.size:
            self._out = np.empty(max(room, 2 * self._out.size), EVENT)
        n = self._serve(Arrivals(crossings.t_ns, crossings.pixel, crossings.on), until_ns)
        self.read_out += n
        return copy_events(self._out[:n])

    def finish(self) -> Events:
        """Return the events that have not left yet; afterwards `push` must not be called again."""
        return self.push(NO_CROSSINGS, _FOREVER_NS)

    @abstractmethod
    def _serve(self, arrivals: Arrivals, until_ns: int) -> int:
        """Run until `until_ns`; return the number of events written to `_out`."""


def new_busy(p: SensorParameters) -> Int64s:
    """Return the ends of the pixels' refractory periods after the acknowledge, all over; empty if there are none."""
    return np.full(p.width * p.height if p.reset.at_acknowledge else 0, -_FOREVER_NS)


class ArbiterReadOut(ReadOut):
    """The arbiter of a sensor, by its size and its `readout` times."""

    def __init__(self, parameters: SensorParameters) -> None:
        super().__init__()
        log_compilation(_serve, "the read-out")
        times, height = parameters.readout, parameters.height
        words = -(-parameters.width // 64)
        group_bits = max(0, (words - 1).bit_length() - 6)
        event_ps, refractory_ns = max(1, round(times.event_ns * 1000)), round(parameters.refractory_us * 1000)
        self._timing = _Timing(parameters.width, times.row_ns, event_ps, group_bits, refractory_ns)
        self._maps = _Maps(
            waiting=np.zeros((height, words), np.uint64),
            polarity=np.zeros((height, words), np.uint64),
            rows=np.zeros(-(-height // 64), np.uint64),
            counts=np.zeros(height, np.int64),
            filled=np.zeros(height, np.uint64),
            latched=np.zeros(words, np.uint64),
            latched_polarity=np.zeros(words, np.uint64),
            latched_words=np.zeros(words, np.int64),
            busy_until_ns=new_busy(parameters),
        )
        self._queue = _Queue(0, 0, 0, 0, 0)
        self._arbiter = _Arbiter(_IDLE, -_FOREVER_NS, height - 1, 0, 0, 0, 0)

    @property
    def pending(self) -> int:
        """Waiting requests, and latched events that have not left."""
        a = self._arbiter
        return super().pending + (a.latched - a.sent if a.phase == _SENDING else 0)

    def _serve(self, arrivals: Arrivals, until_ns: int) -> int:
        n, queue, arbiter = _serve(arrivals, until_ns, self._maps, self._queue, self._arbiter, self._timing, self._out)
        self._queue, self._arbiter = _Queue(*queue), _Arbiter(*arbiter)
        return int(n)


_EVENTS, _LEFT_NS = 0, 1
_AHEAD = 64  # events whose pixels are fetched together


class _Delays(NamedTuple):
    """Logarithm of the delay in ns, mean for each polarity and deviation; share and mean delay in ns of late events.

    `last`: number of events of each pixel and the time at which the last one left, (pixels, 2): side by side, because a
    step's events come in the order of time, and each fetches its pixel from memory.
    """

    root: np.uint64
    late_root: np.uint64
    on: float
    off: float
    deviation: float
    late_share: float
    late_ns: float
    last: Int64s


_Arrays = tuple[Int64s, npt.NDArray[np.uint32], Mask]


@cached_entry
def _delay(
    crossings: _Arrays, window: Window, d: _Delays, pending: Pending, n: int
) -> tuple[tuple[Any, ...], int, npt.NDArray[np.uint64]]:
    """Add crossings to the pending events; return those that stay pending, and the packed events of the window.

    Fast because the pixels of many events are read before their use: the processor then waits for all at once. One
    after another, as each event depends on random numbers, they took twice as long as the rest.
    """
    t_ns, pixels, on = crossings
    pending = reserve(pending, n, t_ns.size)
    fetched = 0
    on_ns, off_ns = int(math.exp(d.on)), int(math.exp(d.off))  # an exponential an event only where delays spread
    for k in range(t_ns.size):
        pixel = pixels[k]
        if k % _AHEAD == 0:
            for later in range(k, min(k + _AHEAD, t_ns.size)):
                fetched ^= d.last[pixels[later], _EVENTS]
        event = d.last[pixel, _EVENTS]
        late_ns = on_ns if on[k] else off_ns
        if d.deviation > 0:
            spread = d.deviation * normal_from(word(stream(d.root, pixel), event))
            late_ns = int(math.exp((d.on if on[k] else d.off) + spread))
        if d.late_share > 0:
            bits = word(stream(d.late_root, pixel), event)
            if unit(high(bits)) < d.late_share:
                late_ns -= int(d.late_ns * math.log(unit(low(bits))))
        leaves_ns = max(t_ns[k] + late_ns, d.last[pixel, _LEFT_NS] + 1)
        d.last[pixel, _EVENTS], d.last[pixel, _LEFT_NS] = event + 1, leaves_ns
        pending.t_ns[n], pending.key[n] = leaves_ns, np.uint64(pixel) << np.uint64(1) | np.uint64(on[k])
        n += 1
    keys = np.empty(n + 1, np.uint64)
    keys[n] = fetched  # a place that `release` may use: without it the compiler would leave out the reads
    released, remaining = release(window, pending, n, keys)
    return pending[0:], remaining, keys[:released]


class Jitter:
    """The delays of an array's events.

    Parameters
    ----------
    parameters : those of the jitter, with `latency_us` > 0.
    seed : keys the delays.
    pixels : number of pixels.

    Attributes
    ----------
    waiting : events that have not left.
    off_latency_us : mean delay of OFF events.
    """

    def __init__(self, parameters: JitterParameters, seed: int, pixels: int) -> None:
        deviation = math.sqrt(math.log1p((parameters.deviation_us / parameters.latency_us) ** 2))
        self.off_latency_us = off_us = parameters.off_latency_us or parameters.latency_us
        on, off = (math.log(us * 1000) - deviation**2 / 2 for us in (parameters.latency_us, off_us))
        roots = root_of(seed, Purpose.LATENCY), root_of(seed, Purpose.LATE)
        late = parameters.late_share, parameters.late_us * 1000
        self._delays = _Delays(*roots, on, off, deviation, *late, last=np.zeros((pixels, 2), np.int64))
        self._pixel_bits = max(1, (pixels - 1).bit_length())
        self.reset(0)

    def reset(self, t_ns: int) -> None:
        """Start at `t_ns` with nothing waiting and events counted from 0."""
        self._delays.last[:] = 0, t_ns
        self._pending, self.waiting = new_pending(), 0
        self._t_ns = t_ns

    def set_off_latency(self, latency_us: float) -> None:
        """Set the mean delay of OFF events that cross from now on, above 0."""
        longer = math.log(latency_us / self.off_latency_us)
        self._delays, self.off_latency_us = self._delays._replace(off=self._delays.off + longer), latency_us

    def step(self, crossings: Crossings, t_ns: int) -> Crossings:
        """Add the crossings of a step, and return the events that leave before its end, `t_ns`."""
        parts, k = [], 0
        while t_ns - self._t_ns > LONGEST_NS:
            end_ns = self._t_ns + LONGEST_NS
            n = int(np.searchsorted(crossings.t_ns, end_ns))
            parts.append(self._advance(crossings, slice(k, n), end_ns))
            k = n
        parts.append(self._advance(crossings, slice(k, len(crossings)), t_ns))
        return joined(parts)

    def _advance(self, crossings: Crossings, span: slice, t_ns: int) -> Crossings:
        """Delay some of the crossings; return the events that leave until `t_ns`, at most LONGEST_NS from now."""
        window = Window(0, self._t_ns, t_ns, self._pixel_bits)
        arrays = crossings.t_ns[span], crossings.pixel[span], crossings.on[span]
        pending, self.waiting, keys = _delay(arrays, window, self._delays, self._pending, self.waiting)
        self._pending, self._t_ns = Pending(*pending), t_ns
        return unpacked(keys, window.t0_ns, self._pixel_bits)

    def last_ns(self) -> int:
        """Return the time at which the last waiting event leaves; the present time if none waits."""
        return int(self._pending.t_ns[: self.waiting].max(initial=self._t_ns))
