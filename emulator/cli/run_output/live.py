"""Live table of a run: rates, lateness, and the state and counts of each link."""

from __future__ import annotations

from collections import deque
from types import TracebackType
from typing import Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from emulator.cli.run_output.latency import quantile_text
from emulator.rig.loading import Rig
from emulator.run.outcome import RunStatus

__all__ = ["LiveTable"]

_PLAIN_PERIOD_S = 5.0
_RATE_WINDOW = 10  # status reports over which rates are averaged


class LiveTable:
    """Shows RunStatus: a table on a terminal; otherwise a line every 5 s."""

    def __init__(self, rig: Rig, console: Console) -> None:
        self._title = f"{rig.name}: {rig.title}"
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._past: deque[RunStatus] = deque(maxlen=_RATE_WINDOW)
        self._next_line_s = 0.0

    def __enter__(self) -> Self:
        self._console.print(self._title)
        if self._live:
            self._live.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        if self._live:
            self._live.stop()

    def update(self, status: RunStatus) -> None:
        """Show a newer status."""
        self._past.append(status)
        if self._live:
            self._live.update(self._table(status), refresh=True)
        elif status.wall_seconds >= self._next_line_s:
            self._next_line_s = status.wall_seconds + _PLAIN_PERIOD_S
            self._console.print(self._line(status))

    def _line(self, status: RunStatus) -> str:
        links = ", ".join(f"{name} {r.state} {r.delivered} delivered" for name, r in status.links.items())
        return f"{status.sim_seconds:8.2f} s  {self._rate():.3f} Mev/s  x{self._factor():.2f} real time  {links}"

    def _table(self, status: RunStatus) -> Table:
        table = Table(box=None, pad_edge=False)
        for column in ("link", "state", "delivered", "dropped", "in device", "latency p50/p99 us"):
            table.add_column(column, justify="left" if column in ("link", "state") else "right")
        for name, r in status.links.items():
            latency = f"{quantile_text(r.latency.p50)}/{quantile_text(r.latency.p99)}"
            table.add_row(name, r.state, str(r.delivered), str(r.dropped), str(r.dropped_in_device), latency)
        late = status.lateness
        table.title = (
            f"{status.sim_seconds:.1f} s   {self._rate():.3f} Mev/s   x{self._factor():.2f} real time   "
            f"{status.frames} frames   late {late.frames_late}, worst {late.worst_gap_us / 1000:.1f} ms"
        )
        table.title_justify = "left"
        return table

    def _rate(self) -> float:
        """Events read out per second of stream time over the window, Mev/s."""
        first, last = self._past[0], self._past[-1]
        return (last.read_out - first.read_out) / max(last.sim_seconds - first.sim_seconds, 1e-9) * 1e-6

    def _factor(self) -> float:
        """Stream seconds per wall second over the window."""
        first, last = self._past[0], self._past[-1]
        return (last.sim_seconds - first.sim_seconds) / max(last.wall_seconds - first.wall_seconds, 1e-9)
