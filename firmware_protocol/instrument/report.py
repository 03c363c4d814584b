"""Housekeeping: when it is due, and what it says."""

from __future__ import annotations

from dataclasses import dataclass

from firmware_protocol.event_device import CameraCounters
from firmware_protocol.instrument.rate import Selection
from firmware_protocol.packets.housekeeping import EdgeCounts, EventCounts, Housekeeping, LinkCounts, Mode, TimeStatus

__all__ = ["Reporter", "State"]

_MOST_HZ = 0xFFFF_FFFF


@dataclass(frozen=True)
class State:
    """What an instrument has to tell of itself; `now_us` is stream time, `own_us` the camera's."""

    now_us: int
    own_us: int
    streaming: bool
    time_status: TimeStatus
    tick_us: int
    rate_limit: int
    selection: Selection
    temperature_c: float
    counters: CameraCounters
    link: LinkCounts


class Reporter:
    """Makes housekeeping reports, one every `period_us` of stream time; with 0 only those that are asked for."""

    def __init__(self, period_us: int) -> None:
        self._period_us = period_us
        self._next_us = 0
        self._last_us = self._offered = self._sent = 0

    def due(self, now_us: int) -> bool:
        """Say whether the next report is due."""
        return self._period_us > 0 and now_us >= self._next_us

    def report(self, state: State) -> Housekeeping:
        """Return the report; rates are since the last one."""
        c, selection = state.counters, state.selection
        seconds = (state.now_us - self._last_us) * 1e-6
        offered_hz, sent_hz = (
            min(_MOST_HZ, round(count / seconds)) if seconds > 0 else 0
            for count in (c.offered - self._offered, c.delivered - self._sent)
        )
        self._last_us, self._offered, self._sent = state.now_us, c.offered, c.delivered
        if self._period_us:
            self._next_us = (state.now_us // self._period_us + 1) * self._period_us
        return Housekeeping(
            t_us=state.own_us,
            region=(selection.x, selection.y, selection.width, selection.height),
            mode=Mode.STREAMING if state.streaming else Mode.STOPPED,
            time_status=state.time_status,
            offered_hz=offered_hz,
            sent_hz=sent_hz,
            temperature_centi_c=round(100 * state.temperature_c),
            tick_us=state.tick_us,
            rate_limit_hz=state.rate_limit,
            events=_events(c),
            edges=EdgeCounts(c.edges.offered, c.edges.delivered, c.edges.ignored, c.edges.dropped),
            link=state.link,
        )


def _events(c: CameraCounters) -> EventCounts:
    return EventCounts(
        offered=c.offered,
        sent=c.delivered,
        waiting=c.queued,
        not_running=c.not_running,
        not_selected=c.not_selected,
        over_rate=c.dropped_rate,
        too_late=c.dropped_late,
        buffer_full=c.dropped_fifo,
        flushed=c.flushed,
        lost_on_link=c.lost_on_link,
    )
