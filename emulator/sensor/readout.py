"""The read-out: one arbiter that turns requests of pixels into events on the output bus.

A pixel that fires raises a request and holds it until served; a crossing of a pixel whose request still waits is lost,
and counted. The arbiter, whenever it is free and any request waits, does this:

    pick     the next row with requests, going round from the row after the one served last
    latch    row_ns later: take all requests of that row at that moment; their pixels are free again
    send     these, by rising column, one each event_ns; an event is stamped when it leaves

after which it is free. A decision at time T knows the requests raised up to and including T and no others, so the
result does not depend on how crossings are split over calls of `push`. No row is served twice while another waits (the
arbiter is not greedy, Lichtsteiner et al. 2008), and the bus sends at most 1 / event_ns.

Not modelled: a held pixel's comparator stays in reset, so its reference would be read anew when it is served. Here the
pixel goes on as if served at once, and only its events are lost; the two differ when the wait is longer than the
refractory period.

Linear time: requests and rows are bit maps, 64 to a word, and nothing is sorted or searched event by event.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from emulator.sensor.compiled import SOURCES, entry, kernel, say_if_not_compiled
from emulator.sensor.elementary import lowest_bit
from emulator.sensor.pixels import Crossings
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import EVENT, Events

__all__ = ["ReadOut"]

_FOREVER_NS = (1 << 63) - 1

_Words = npt.NDArray[np.uint64]
_Int64s = npt.NDArray[np.int64]

# Registers of the arbiter, all int64.
_PHASE, _FREE, _READY, _ROW, _LATCH, _WAITING, _SENT, _LATCHED, _WORD, _LOST = range(10)
_REGISTERS = 10
# Phases.
_IDLE, _PICKED, _SENDING = range(3)


class _Arbiter(NamedTuple):
    """Bit maps and registers; all of the state."""

    waiting: _Words  # (height, words), bit set: this pixel holds a request
    polarity: _Words  # (height, words), of those requests
    rows: _Words  # bit set: this row has requests
    latched: _Words  # (words,), of the row being sent, not yet sent
    latched_polarity: _Words
    registers: _Int64s


class _Timing(NamedTuple):
    width: int
    row_ns: int
    event_ps: int


@kernel
def _admit(
    t_ns: _Int64s, pixel: npt.NDArray[np.uint32], on: npt.NDArray[np.bool_], k: int, arbiter: _Arbiter, timing: _Timing
) -> None:
    """Let crossing k raise its pixel's request, or be lost if that still waits."""
    registers = arbiter.registers
    row = pixel[k] // timing.width
    x = pixel[k] - row * timing.width
    word, bit = x >> 6, np.uint64(1) << np.uint64(x & 63)
    if arbiter.waiting[row, word] & bit:
        registers[_LOST] += 1
        return
    if registers[_WAITING] == 0:
        registers[_READY] = t_ns[k]
    registers[_WAITING] += 1
    arbiter.waiting[row, word] |= bit
    arbiter.rows[row >> 6] |= np.uint64(1) << np.uint64(row & 63)
    if on[k]:
        arbiter.polarity[row, word] |= bit


@kernel
def _next_row(rows: _Words, last: int, height: int) -> int:
    """Return the first row with requests after `last`, going round; there is one."""
    first = last + 1 if last + 1 < height else 0
    word = first >> 6
    here = rows[word] & (~np.uint64(0) << np.uint64(first & 63))
    while here == 0:
        word = word + 1 if word + 1 < rows.size else 0
        here = rows[word]
    return int(word * 64 + np.int64(lowest_bit(here)))


@kernel
def _latch(arbiter: _Arbiter) -> None:
    """Take all requests of the picked row."""
    registers, row = arbiter.registers, arbiter.registers[_ROW]
    n = 0
    for word in range(arbiter.latched.size):
        bits = arbiter.waiting[row, word]
        arbiter.latched[word] = bits
        arbiter.latched_polarity[word] = arbiter.polarity[row, word]
        arbiter.waiting[row, word] = arbiter.polarity[row, word] = np.uint64(0)
        while bits != 0:
            bits &= bits - np.uint64(1)
            n += 1
    arbiter.rows[row >> 6] &= ~(np.uint64(1) << np.uint64(row & 63))
    registers[_WAITING] -= n
    registers[_LATCHED], registers[_SENT], registers[_WORD] = n, 0, 0


@kernel
def _send(arbiter: _Arbiter, timing: _Timing, until_ns: int, out: Events, n: int) -> int:
    """Send latched events that leave before `until_ns`, into `out` from n on; return the new n."""
    registers = arbiter.registers
    sent, row, latch_ns = registers[_SENT], registers[_ROW], registers[_LATCH]
    word = registers[_WORD]
    while sent < registers[_LATCHED]:
        exit_ns = latch_ns + ((sent + 1) * timing.event_ps + 999) // 1000
        if exit_ns >= until_ns:
            break
        while arbiter.latched[word] == 0:
            word += 1
        bits = arbiter.latched[word]
        x = lowest_bit(bits)
        arbiter.latched[word] = bits & (bits - np.uint64(1))
        event = out[n]
        event.t = exit_ns // 1000
        event.x = np.int64(word) * 64 + np.int64(x)
        event.y = row
        event.on = (arbiter.latched_polarity[word] >> x) & np.uint64(1) != 0
        n += 1
        sent += 1
    registers[_SENT], registers[_WORD] = sent, word
    if sent == registers[_LATCHED]:
        registers[_PHASE] = _IDLE
        registers[_FREE] = latch_ns + (sent * timing.event_ps + 999) // 1000
    return n


@entry
def _serve(
    t_ns: _Int64s,
    pixel: npt.NDArray[np.uint32],
    on: npt.NDArray[np.bool_],
    until_ns: int,
    arbiter: _Arbiter,
    timing: _Timing,
    out: Events,
    sources: int = SOURCES,
) -> int:
    """Run the arbiter over all that happens before `until_ns`; return the number of events written to `out`."""
    registers = arbiter.registers
    n = k = 0
    while True:
        if registers[_PHASE] == _SENDING:
            n = _send(arbiter, timing, until_ns, out, n)
            if registers[_PHASE] == _SENDING:
                break
        if registers[_PHASE] == _IDLE:
            while k < t_ns.size and (t_ns[k] <= registers[_FREE] or registers[_WAITING] == 0):
                _admit(t_ns, pixel, on, k, arbiter, timing)
                k += 1
            start_ns = max(registers[_FREE], registers[_READY])
            if registers[_WAITING] == 0 or start_ns >= until_ns:
                break
            while k < t_ns.size and t_ns[k] <= start_ns:
                _admit(t_ns, pixel, on, k, arbiter, timing)
                k += 1
            registers[_ROW] = _next_row(arbiter.rows, registers[_ROW], arbiter.waiting.shape[0])
            registers[_LATCH], registers[_PHASE] = start_ns + timing.row_ns, _PICKED
        while k < t_ns.size and t_ns[k] <= registers[_LATCH]:
            _admit(t_ns, pixel, on, k, arbiter, timing)
            k += 1
        if registers[_LATCH] >= until_ns:
            break
        _latch(arbiter)
        registers[_PHASE] = _SENDING
    while k < t_ns.size:
        _admit(t_ns, pixel, on, k, arbiter, timing)
        k += 1
    return n


class ReadOut:
    """The arbiter of one sensor.

    Parameters
    ----------
    parameters : the sensor: its size and its `readout` times.

    Attributes
    ----------
    raised : crossings pushed; always lost_at_readout + read_out + pending.
    read_out : events returned.
    """

    def __init__(self, parameters: SensorParameters) -> None:
        times = parameters.readout
        words = -(-parameters.width // 64)
        self._timing = _Timing(parameters.width, times.row_ns, max(1, round(times.event_ns * 1000)))
        self._arbiter = _Arbiter(
            waiting=np.zeros((parameters.height, words), np.uint64),
            polarity=np.zeros((parameters.height, words), np.uint64),
            rows=np.zeros(-(-parameters.height // 64), np.uint64),
            latched=np.zeros(words, np.uint64),
            latched_polarity=np.zeros(words, np.uint64),
            registers=np.zeros(_REGISTERS, np.int64),
        )
        self._arbiter.registers[_ROW] = parameters.height - 1
        self._arbiter.registers[_FREE] = -_FOREVER_NS
        self._until_ns = -_FOREVER_NS
        self._out = np.empty(0, EVENT)
        self.raised = 0
        self.read_out = 0

    @property
    def lost_at_readout(self) -> int:
        """Crossings of pixels whose request still waited."""
        return int(self._arbiter.registers[_LOST])

    @property
    def pending(self) -> int:
        """Requests that wait, and latched events that have not left."""
        registers = self._arbiter.registers
        sending = registers[_LATCHED] - registers[_SENT] if registers[_PHASE] == _SENDING else 0
        return int(registers[_WAITING] + sending)

    def push(self, crossings: Crossings, until_ns: int) -> Events:
        """Take crossings, and return the events that leave before `until_ns`.

        Parameters
        ----------
        crossings : sorted by time, none before the last `until_ns` and none after this one.
        until_ns : stream time up to which all crossings are known now.

        Returns
        -------
        (n,) EVENT, sorted by t, which is the time of leaving in us, rounded down.

        Raises
        ------
        ValueError
            Time goes back.
        """
        t_ns = crossings.t_ns
        if until_ns < self._until_ns:
            raise ValueError(f"until_ns = {until_ns}: before the last one, {self._until_ns}; time does not go back")
        if t_ns.size and (t_ns[0] < self._until_ns or t_ns[-1] > until_ns):
            raise ValueError(
                f"crossings from {t_ns[0]} to {t_ns[-1]} ns: must lie from {self._until_ns} to {until_ns} ns"
            )
        self.raised += t_ns.size
        self._until_ns = until_ns
        room = self.pending + t_ns.size
        if room > self._out.size:
            self._out = np.empty(max(room, 2 * self._out.size), EVENT)
        say_if_not_compiled(_serve, "the read-out")
        n = _serve(t_ns, crossings.pixel, crossings.on, until_ns, self._arbiter, self._timing, self._out)
        self.read_out += n
        return self._out[:n].copy()

    def finish(self) -> Events:
        """Return the events that have not left yet; nothing is pending afterwards, and nothing can be pushed."""
        nothing = Crossings(np.empty(0, np.int64), np.empty(0, np.uint32), np.empty(0, np.bool_))
        return self.push(nothing, _FOREVER_NS)
