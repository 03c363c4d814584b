"""From events that wait to transfers of EVT3 words.

Words are made when the host asks for them, so that what is dropped while it waits leaves no trace in the stream. In a
silence, words tell the time every 4096 us: decoders lose it after 8.4 s.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from firmware_protocol.edges import Edges, empty_edges
from firmware_protocol.event_copies import copy_events, join_events
from firmware_protocol.events import Events, empty_events
from firmware_protocol.evt3.encoding import Evt3Encoder
from firmware_protocol.imx636.registers import SIZE
from firmware_protocol.usb.device import Transfer

__all__ = ["Outflow"]

_SILENCE_US = 4096  # a high part of the time
_LONGEST_GAP_US = 1_000_000  # between words, without time words of a silence in between
_LONGEST_SILENCE_US = 3_600_000_000  # told in one transfer
_FEWEST_EVENTS = 16  # made into words together, also for a host that asks for less
_MOST_EDGES = 1024


class Outflow:
    """Events and edges of one run of the sensor on their way out.

    Attributes
    ----------
    epoch_us
        Stream time at which the sensor's clock was zero.
    queued, edges_queued
        Events and edges that wait.
    """

    def __init__(self, epoch_us: int, capacity: int) -> None:
        self.epoch_us = self._told_us = epoch_us
        self._capacity = capacity
        self._encoder = Evt3Encoder(width=SIZE[0])
        self._waiting: deque[Events] = deque()
        self._edges = empty_edges()
        self._cut: Transfer | None = None  # what is left of words that the host asked too little for
        self._queued = 0

    @property
    def queued(self) -> int:
        """Events that wait."""
        return self._queued + (0 if self._cut is None else len(self._cut.events))

    @property
    def edges_queued(self) -> int:
        """Edges that wait."""
        return len(self._edges) + (0 if self._cut is None else len(self._cut.edges))

    @property
    def room(self) -> int:
        """Events that fit now."""
        return max(0, self._capacity - self.queued)

    def put(self, events: Events) -> int:
        """Take as many of events (n,) EVENT, sorted, as fit, and return how many that are; they are copied."""
        fitting = events[: self.room]
        if len(fitting):
            self._waiting.append(copy_events(fitting))
            self._queued += len(fitting)
        return len(fitting)

    def put_edges(self, edges: Edges) -> int:
        """Take as many of edges (n,) EDGE, sorted, as fit, and return how many; old ones get the time told last."""
        fitting = edges[: max(0, _MOST_EDGES - len(self._edges))]
        self._edges = np.concatenate([self._edges, fitting])
        return len(fitting)

    def take(self, now_us: int, max_bytes: int) -> Transfer | None:
        """Remove up to `max_bytes` of words; None where there is nothing to tell yet."""
        if max_bytes < 2:
            return None
        whole = self._cut or self._next(now_us, max_bytes)
        if whole is None or len(whole.data) <= max_bytes:
            self._cut = None
            return whole
        end = max_bytes & ~1
        self._cut = Transfer(whole.data[end:], whole.events, whole.epoch_us, whole.edges)
        return Transfer(whole.data[:end], epoch_us=whole.epoch_us)

    def _next(self, now_us: int, max_bytes: int) -> Transfer | None:
        begin_us = self._first_us()
        if begin_us is None or begin_us > now_us:
            return self._silence(now_us)
        if begin_us - self._told_us > _LONGEST_GAP_US:
            return self._silence(begin_us)
        return self._words(begin_us, now_us, max_bytes)

    def _first_us(self) -> int | None:
        firsts = [int(self._waiting[0]["t"][0])] if self._waiting else []
        if len(self._edges):
            firsts.append(max(int(self._edges["t"][0].astype(np.int64)), self._told_us))
        return min(firsts, default=None)

    def _silence(self, until_us: int) -> Transfer | None:
        if until_us - self._told_us < _SILENCE_US:
            return None
        self._told_us = min(until_us, self._told_us + _LONGEST_SILENCE_US)
        words = self._encoder.advance(self._told_us - self.epoch_us)
        return Transfer(words, epoch_us=self.epoch_us) if words else None

    def _words(self, begin_us: int, now_us: int, max_bytes: int) -> Transfer:
        until_us = min(now_us, begin_us + _LONGEST_GAP_US)
        room = max(max_bytes // 8 - 2, _FEWEST_EVENTS)
        events = self._taken(until_us, room)
        if len(events) == room:
            until_us = int(events["t"][-1])
        edges = self._taken_edges(until_us)
        last_us = max(int(each["t"][-1]) for each in (events, edges) if len(each))
        self._told_us = max(self._told_us, last_us)
        words = self._encoder.encode(self._own(events), self._own(edges))
        return Transfer(words, events, self.epoch_us, edges)

    def _taken(self, until_us: int, room: int) -> Events:
        """Return up to `room` events that are not later than `until_us`."""
        taken = []
        while self._waiting and room:
            first = self._waiting[0]
            count = min(room, int(np.searchsorted(first["t"], until_us, side="right")))
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

    def _taken_edges(self, until_us: int) -> Edges:
        """Return the edges that are not later than `until_us`; the sensor stamps those itself that come late."""
        times = np.maximum.accumulate(np.maximum(self._edges["t"].astype(np.int64), self._told_us))
        due = times <= until_us
        edges = self._edges[due].copy()
        edges["t"] = times[due]
        self._edges = self._edges[~due]
        return edges

    def _own(self, records: Events | Edges) -> Events | Edges:
        own = copy_events(records) if records.dtype == empty_events().dtype else records.copy()
        own["t"] -= np.uint64(self.epoch_us)
        return own
