"""The counter registers of a DAVIS346: what has happened since power-on, by the counters of its parts."""

from __future__ import annotations

from firmware_protocol.davis346.filters import DvsFilters
from firmware_protocol.davis346.registers import RegisterFile, Statistic
from firmware_protocol.davis346.stream import EventStream

__all__ = ["Statistics"]


class Statistics:
    """Brings the counter registers up to date when they are read.

    One FIFO stands in this model for the DVS module's and the USB buffers', so both dropped counters show its drops.
    """

    def __init__(self, stream: EventStream, filters: DvsFilters) -> None:
        self._stream = stream
        self._filters = filters
        self.power_on()

    def power_on(self) -> None:
        """Count from here."""
        self._before = self._counted()

    def refresh(self, registers: RegisterFile) -> None:
        """Write the counts since power-on into the registers."""
        for statistic, count in self._counted().items():
            registers.count(statistic, count - self._before[statistic])

    def _counted(self) -> dict[Statistic, int]:
        """Return what the parts have counted since they were made."""
        events, filters = self._stream.counters, self._filters
        return {
            Statistic.DVS_ROWS: events.rows,
            Statistic.DVS_COLUMNS: events.accepted,
            Statistic.DVS_DROPPED: events.dropped_fifo,
            Statistic.DVS_FILTERED_PIXELS: filters.hot,
            Statistic.DVS_FILTERED_BACKGROUND_ACTIVITY: filters.isolated,
            Statistic.DVS_FILTERED_REFRACTORY: filters.too_soon,
            Statistic.MUX_DVS_DROPPED: events.dropped_fifo,
            Statistic.MUX_EXTINPUT_DROPPED: self._stream.mark_counters.dropped_fifo,
        }
