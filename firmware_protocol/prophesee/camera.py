"""Parts that all cameras with a sensor of Prophesee's share: gate, selection, queue, fates, biases.

    array --offer-------> gate -> selection -> Outflow -> words of the link
    input --offer_edges-> gate -------------->

A camera adds its protocol: the registers, which set the gate, the selection and the biases, and its way out.

`Outflow` holds events and edges on their way from the selection to the words of a link:

    put, put_edges --> [events] [edges] --> due, taken --> EVT words --> transfers, or blocks of packets

Words are made when the host reads, so that items dropped while they wait leave no trace in the stream. Edges come
before events of the same time; one that is older than the time already sent, or than the edge before it, gets that
time. Decoders lose the time after 8.4 s without words, so words carry it during a silence.

Event rate control, which several sensors have alike: the first events of each period of the sensor's clock leave it,
the others do not. How a sensor spreads the losses over a period is not public.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from typing import Generic, TypeVar

import numpy as np
import numpy.typing as npt

from firmware_protocol.device.event_device import HostAdjusted, StartsSilent
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Items, Numbers
from firmware_protocol.events import Edges, Events, copy_events, empty_edges, empty_events, join_events, level_changes
from firmware_protocol.evt.words import Coder
from firmware_protocol.prophesee.biases import BiasModel

LONGEST_GAP_US = 1_000_000  # between words, without time words of a silence in between
_LONGEST_SILENCE_US = 3_600_000_000  # made up for at once


@dataclass(frozen=True)
class OutflowLimits:
    """Most events and edges of an outflow that wait; after `silence_us` without words, words carry the time alone."""

    events: int
    edges: int
    silence_us: int


def before(events: Events, until_us: int) -> int:
    """Return the number of events (n,) EVENT, sorted, that are older; numpy's own search copies all times first."""
    times = events["t"]
    return bisect_left(range(len(times)), until_us, key=lambda place: int(times[place]))


_Taken = TypeVar("_Taken", bound=Items, covariant=True)


class Outflow(ABC, Generic[_Taken]):
    """Outgoing events and edges of one run of the sensor, in the order of time: an `ItemEncoder`.

    `epoch_us`: stream time at which the sensor's clock was zero.
    """

    def __init__(self, encoder: Coder, epoch_us: int, limits: OutflowLimits) -> None:
        self.epoch_us = self._reported_us = epoch_us
        self._encoder = encoder
        self._limits = limits
        self._waiting: deque[Events] = deque()
        self._edges = empty_edges()
        self._queued = 0

    @property
    def waiting(self) -> Numbers:
        """Numbers of events and edges in the queues."""
        return Numbers(self._queued, len(self._edges))

    @property
    def room(self) -> int:
        """Events that fit now."""
        return max(0, self._limits.events - self.waiting.events)

    @abstractmethod
    def take(self, now_us: int, room: int) -> _Taken | None:
        """Make the words that are due, as many as `room` permits, and remove their items."""

    def put(self, events: Events) -> int:
        """Queue as many of events (n,) EVENT, sorted, as fit; return their number; they are copied."""
        fitting = events[: self.room]
        if len(fitting):
            self._waiting.append(copy_events(fitting))
            self._queued += len(fitting)
        return len(fitting)

    def put_edges(self, edges: Edges) -> int:
        """Queue as many of edges (n,) EDGE as fit, in the order of their times; return their number."""
        fitting = edges[: max(0, self._limits.edges - len(self._edges))]
        joined = np.concatenate([self._edges, fitting])
        self._edges = joined[np.argsort(joined["t"], kind="stable")]
        return len(fitting)

    def clear(self) -> None:
        """Empty the queues."""
        self._waiting.clear()
        self._edges, self._queued = empty_edges(), 0

    def _first_us(self) -> int | None:
        """Return the time of the first item that waits; None if none waits."""
        firsts = [int(self._waiting[0]["t"][0])] if self._waiting else []
        if len(self._edges):
            firsts.append(max(int(self._edges["t"][0].astype(np.int64)), self._reported_us))
        return min(firsts, default=None)

    def _due_us(self, now_us: int) -> int | None:
        """Return the time of the first item; None if it is not due, or is so late that time words must come first."""
        first_us = self._first_us()
        if first_us is None or first_us > now_us or first_us - self._reported_us > LONGEST_GAP_US:
            return None
        return first_us

    def _silence_words(self, now_us: int) -> bytes:
        """Return the words that carry only the time, up to the first item; none while the last words are recent."""
        first_us = self._first_us()
        until_us = now_us if first_us is None else min(first_us, now_us)
        if until_us - self._reported_us < self._limits.silence_us:
            return b""
        self._reported_us = min(until_us, self._reported_us + _LONGEST_SILENCE_US)
        return self._encoder.advance(self._reported_us - self.epoch_us)

    def _taken(self, until_us: int, room: int) -> Events:
        """Remove and return up to `room` events that are older than `until_us`."""
        taken: list[Events] = []
        while self._waiting and room:
            first = self._waiting[0]
            count = min(room, before(first, until_us))
            if not count:
                break
            taken.append(first[:count])
            room -= count
            self._queued -= count
            self._waiting[0] = first[count:]
            if count < len(first):
                break
            self._waiting.popleft()
        return join_events(taken) if taken else empty_events()

    def _put_back(self, events: Events) -> None:
        """Put the last events taken back into the queue."""
        if len(events):
            self._waiting.appendleft(events)
            self._queued += len(events)

    def _due_edges(self, until_us: int) -> Edges:
        """Return the edges that are not later than `until_us`, with the time that they are sent with; they stay."""
        times = np.maximum.accumulate(np.maximum(self._edges["t"].astype(np.int64), self._reported_us))
        count = int(np.count_nonzero(times <= until_us))
        edges = self._edges[:count].copy()
        edges["t"] = times[:count]
        return edges

    def _reach(self, events: Events, edges: Edges) -> None:
        """Remove edges that were made into words, and note the time of the last item in words."""
        self._edges = self._edges[len(edges) :]
        last_us = max(int(records["t"][-1]) for records in (events, edges) if len(records))
        self._reported_us = max(self._reported_us, last_us)


_Out = TypeVar("_Out", bound=Outflow[Items])


class PropheseeCamera(StartsSilent, HostAdjusted, Generic[_Out]):
    """A camera with a sensor of Prophesee's; `_outflow` is that of the present run of the sensor.

    Parameters
    ----------
    size : (width, height) of the array.
    biases : effect of the biases on the sensor.
    pulse_us : length of a pulse at the trigger input.
    """

    epoch_us = 0

    def __init__(self, size: tuple[int, int], biases: BiasModel, outflow: _Out, pulse_us: int) -> None:
        self._size = size
        self._pulse_us = pulse_us
        self._bias_model = biases
        self._outflow = outflow
        self._fates = Fates()
        self._silence_end_us = 0

    @property
    def room_events(self) -> int:
        """Events that fit the buffer now."""
        return self._outflow.room

    @property
    def silent_until_us(self) -> int:
        """End of the silence after the start; 0 while the sensor is stopped."""
        return self._silence_end_us if self._running else 0

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect on the pixels of the biases that hosts wrote; empty while they are the factory's."""
        return self._bias_model.factors(self._bias_steps)

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that hosts changed without an effect here, each with the reason."""
        return self._bias_model.without_effect(self._bias_steps)

    @property
    def _waiting(self) -> Numbers:
        return self._outflow.waiting

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT; raises ValueError if they go back in time or lie outside the array."""
        if not len(events):
            return
        self._check(events)
        self._now_us = int(events["t"][-1])
        begun = events[before(events, self._silence_end_us) :] if self._running else events[:0]
        selected = self._select(begun)
        fates = self._fates
        fates.offered += len(events)
        fates.not_running += len(events) - len(begun)
        fates.not_selected += selected.outside
        fates.dropped_rate += selected.beyond_rate
        fates.dropped_fifo += len(selected.events) - self._outflow.put(selected.events)

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges (n,) EDGE to the trigger input."""
        self._fates.edges.offered += len(edges)
        if self._detects and self._now_us >= self._silence_end_us:
            self._put_edges(edges)
        else:
            self._fates.edges.ignored += len(edges)

    @property
    @abstractmethod
    def _running(self) -> bool:
        """True if events leave the sensor."""

    @property
    def _detects(self) -> bool:
        """True if the trigger input is on."""
        return self._running

    @property
    @abstractmethod
    def _bias_steps(self) -> Mapping[str, int]:
        """Steps of each bias away from the factory's value, by Prophesee's names."""

    @abstractmethod
    def _select(self, events: Events) -> Selected:
        """Return the part of events, (n,) EVENT, that the registers select."""

    def _put_edges(self, edges: Edges) -> None:
        """Queue edges, (n,) EDGE, that the input has detected: both changes of a pulse."""
        changes = level_changes(edges, self._pulse_us)
        changes["seq"] = 0  # of the source of triggers; a word has no room for it
        self._fates.edges.added += len(changes) - len(edges)
        self._fates.edges.dropped_fifo += len(changes) - self._outflow.put_edges(changes)

    def _check(self, events: Events) -> None:
        if int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any()):
            raise ValueError("events go back in time")
        width, height = self._size
        if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
            raise ValueError(f"events outside the {width} x {height} array")


Mask = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Selected:
    """Events (n,) EVENT that pass, and the numbers of the others, by reason."""

    events: Events
    outside: int
    beyond_rate: int


class RateControl:
    """Limit of the events in each period of the device's clock, while it is `on`: the first `most` of `period_us`."""

    def __init__(self, period_us: int) -> None:
        self.period_us, self.most = period_us, 0
        self._period, self._seen = -1, 0
        self.on = False

    def selected(self, events: Events, candidates: Events, epoch_us: int) -> Selected:
        """Return the part of `candidates` among `events` that passes, both sorted; the clock was 0 at `epoch_us`."""
        passing = candidates[self._passing(candidates, epoch_us)] if self.on else candidates
        return Selected(passing, len(events) - len(candidates), len(candidates) - len(passing))

    def _passing(self, events: Events, epoch_us: int) -> Mask:
        """Return a mask of the events (n,) EVENT, sorted, that pass, (n,) bool: the first ones of each period."""
        if not len(events):
            return np.zeros(0, np.bool_)
        periods = (events["t"].astype(np.int64) - epoch_us) // self.period_us
        ranks = np.arange(len(periods)) - np.searchsorted(periods, periods)
        if periods[0] == self._period:
            ranks[periods == self._period] += self._seen
        self._period, self._seen = int(periods[-1]), int(ranks[-1]) + 1
        return ranks < self.most


@dataclass(frozen=True)
class RateBand:
    """Bounds of a noise filter, in events in a period of the device's clock.

    Attributes
    ----------
    period_us : length of a period.
    low_on, low_off : below the first, it drops all events; above the second, no more.
    high_off, high_on : above the second, it drops all events; below the first, no more.
    """

    period_us: int
    low_on: int
    low_off: int
    high_off: int
    high_on: int


class NoiseFilter:
    """Filter of all events by their rate: it decides at the end of a period about the next one."""

    def __init__(self) -> None:
        self.configure(None)

    def configure(self, band: RateBand | None, is_low: bool = False) -> None:
        """Begin anew with a band, None: off; `is_low`: it drops events until their rate is high enough."""
        self._band = band
        self._period, self._count = -1, 0
        self._is_low, self._is_high = is_low, False

    def passed(self, events: Events, epoch_us: int) -> Events:
        """Return the part that passes of events (n,) EVENT, sorted; the sensor's clock was zero at `epoch_us`."""
        if self._band is None or not len(events):
            return events
        periods = (events["t"].astype(np.int64) - epoch_us) // self._band.period_us
        ends = [*(np.flatnonzero(np.diff(periods)) + 1).tolist(), len(events)]
        passing = np.zeros(len(events), np.bool_)
        for start, end in pairwise([0, *ends]):
            self._begin(int(periods[start]), self._band)
            passing[start:end] = not (self._is_low or self._is_high)
            self._count += end - start
        return events[passing]

    def _begin(self, period: int, band: RateBand) -> None:
        """End the periods before `period`; several without events have the effect of one."""
        if period == self._period:
            return
        if self._period >= 0:
            self._judge(self._count, band)
            if period > self._period + 1:
                self._judge(0, band)
        self._period, self._count = period, 0

    def _judge(self, count: int, band: RateBand) -> None:
        if count < band.low_on:
            self._is_low = True
        elif count > band.low_off:
            self._is_low = False
        if count > band.high_on:
            self._is_high = True
        elif count < band.high_off:
            self._is_high = False


def unpacked(words: npt.NDArray[np.uint32], pixels: int) -> Mask:
    """Return a bit for each of `pixels` pixels, (pixels,) bool: bit k of word i is pixel 32 i + k."""
    return np.unpackbits(words.astype("<u4").view(np.uint8), count=pixels, bitorder="little").astype(np.bool_)
