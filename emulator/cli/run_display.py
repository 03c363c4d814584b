"""Live table of a run, with rates, lateness, and the state and counts of each link; its report and its live page."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from emulator.cli.output import LACKING, WRONG_USE, console, failing, status
from emulator.cli.run_summary import quantile_text
from emulator.light import MachineLacks
from emulator.rig.loading import Rig
from emulator.run.changes import Change
from emulator.run.control import FaultInjection
from emulator.run.outcome import Rates, RunResult, RunStatus
from emulator.run.session import Session
from transports.link.edges import EdgeSink
from transports.link.process import LinkSetup

if TYPE_CHECKING:
    from emulator.live_page.controls import Repeats
    from emulator.live_page.messages import Address
    from emulator.live_page.page import LivePage
    from emulator.run.report.files import RunReporter


_PLAIN_PERIOD_S = 5.0


class LiveTable:
    """Display of RunStatus: a table on a terminal; otherwise a line every 5 s."""

    def __init__(self, rig: Rig, console: Console) -> None:
        self._title = f"{rig.name}: {rig.title}"
        self._console = console
        self._live = Live(console=console, auto_refresh=False, transient=True) if console.is_terminal else None
        self._rates = Rates()
        self._next_line_s = 0.0

    def __enter__(self) -> Self:
        self._console.print(self._title)
        if self._live:
            self._live.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._live:
            self._live.stop()

    def update(self, status: RunStatus) -> None:
        """Show a newer status."""
        rates = self._rates.renew(status)
        speed = f"{rates['events_per_s'] * 1e-6:.3f} Mev/s   x{rates['real_time_factor']:.2f} real time"
        if self._live:
            self._live.update(self._table(status, speed), refresh=True)
        elif status.wall_seconds >= self._next_line_s:
            self._next_line_s = status.wall_seconds + _PLAIN_PERIOD_S
            links = ", ".join(f"{name} {r.state} {r.delivered} delivered" for name, r in status.links.items())
            self._console.print(f"{status.sim_seconds:8.2f} s   {speed}   {links}")

    def _table(self, status: RunStatus, speed: str) -> Table:
        table = Table(box=None, pad_edge=False)
        for column in ("link", "state", "delivered", "dropped", "in device", "latency p50/p99 us"):
            table.add_column(column, justify="left" if column in ("link", "state") else "right")
        for name, r in status.links.items():
            latency = f"{quantile_text(r.latency.p50)}/{quantile_text(r.latency.p99)}"
            table.add_row(name, r.state, str(r.delivered), str(r.dropped), str(r.dropped_in_device), latency)
        late = status.lateness
        table.title = (
            f"{status.sim_seconds:.1f} s   {speed}   {status.frames} frames   "
            f"late {late.frames_late}, worst {late.worst_gap_us / 1000:.1f} ms"
        )
        table.title_justify = "left"
        return table


def begin_report(rig: Rig, folder: Path | None) -> RunReporter | None:
    """Make the folder of a report, with files that state no verdict; None without a folder. Raises Failure."""
    if folder is None:
        return None
    from emulator.run.report.files import RunReporter

    with failing(WRONG_USE, OSError, at=f"--report: {folder}"):
        return RunReporter(rig, folder)


def end_report(reporter: RunReporter, result: RunResult, summary: Mapping[str, Any], truth_trouble: str) -> None:
    """Write the report and name it; where that fails the run's own result still stands."""
    try:
        line = f"report: {reporter.write(result, summary, truth_trouble)}"
    except OSError as error:
        line = f"--report: {error.strerror or error} ({reporter.folder}): the report is not whole"
    console.print(line, markup=False)


class OptionalPage:
    """The requested live page, or none."""

    def __init__(self, rig: Rig, requested: str | bool | None, repeats: Repeats | None = None) -> None:
        self._rig = rig
        self._repeats = repeats
        self._address = _address(requested)
        self._trigger: EdgeSink | None = None

    def wired(self, setups: Sequence[LinkSetup[Any]]) -> list[LinkSetup[Any]]:
        """Return the links, with their inputs wired to the page's button where nothing else is."""
        if self._address is None or self._rig.trigger is not None:
            return list(setups)
        from emulator.live_page.page import with_trigger_button

        wired, self._trigger = with_trigger_button(setups)
        return wired

    @contextmanager
    def page(self, session: Session) -> Iterator[LivePage | None]:
        """Serve the page, or give None; raises Failure where it cannot listen there."""
        if self._address is None:
            yield None
            return
        from emulator.live_page.messages import LIVE_PAGE, ViewerCommands
        from emulator.live_page.page import LivePage

        run = self._rig.run
        can_pause = run.pace == "free" and not run.lockstep_us
        inject = FaultInjection(self._rig, session, None, by=LIVE_PAGE).answer
        commands = ViewerCommands(session, inject, self._button(session), can_pause=can_pause, repeats=self._repeats)
        with failing(LACKING, OSError, at=f"--serve: {self._address.host}:{self._address.port}"):
            page = LivePage(self._rig, self._address, commands, self._repeats)
        with page:
            status.print(f"live page: {page.url}", markup=False, soft_wrap=True)
            yield page

    def _button(self, session: Session) -> Callable[[int, int], None] | None:
        """Return the trigger, which records its edges; None where there is none."""
        trigger = self._trigger
        if trigger is None:
            return None
        from emulator.live_page.messages import LIVE_PAGE

        def press(bus_t_ns: int, number: int) -> None:
            early = trigger.early_triggers
            trigger(bus_t_ns, number)
            if trigger.early_triggers == early:
                session.record(Change(trigger.last_us * 1000, LIVE_PAGE, "trigger pulse"))

        return press


def check_serving(requested: str | bool | None) -> None:
    """Raise Failure where the requested page cannot be served."""
    if _address(requested) is None:
        return
    from emulator.live_page.page import check_ui

    with failing(LACKING, MachineLacks):
        check_ui()


def _address(requested: str | bool | None) -> Address | None:
    if requested is None or requested is False:
        return None
    from emulator.live_page.messages import Address, parse_address

    with failing(WRONG_USE, ValueError, at="--serve"):
        return Address() if requested is True else parse_address(requested)
