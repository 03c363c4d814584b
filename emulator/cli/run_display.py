"""Live table of a run: rates, lateness, and the state and counts of each link.

`--report DIR`: observation of a run, and its report when it has ended.

`--serve [HOST:PORT]`: the live page of a run.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from rich.console import Console
from rich.live import Live
from rich.table import Table

from emulator.cli.output import LACKING, WRONG_USE, Failure, console, status
from emulator.cli.run_summary import quantile_text
from emulator.light import MachineLacks, Scene
from emulator.rig.loading import Rig
from emulator.run.control import FaultInjection
from emulator.run.outcome import Rates, RunResult, RunStatus, judge
from emulator.run.session import Operator, Session
from firmware_protocol.events import Events
from transports.link.edges import EdgeSink
from transports.link.process import LinkSetup

if TYPE_CHECKING:
    from emulator.live_page.controls import Repeats
    from emulator.live_page.messages import Address
    from emulator.live_page.page import LivePage
    from emulator.run.report.content import Circumstances
    from emulator.run.report.observation import Observation


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

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
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


class RunReporter:
    """Observation of a run for its report; without a folder it does nothing.

    `began` is the date and time of the run's begin.
    """

    def __init__(self, rig: Rig, folder: Path | None, began: datetime | None = None) -> None:
        self._rig = rig
        self._folder = folder
        self._seen: Observation | None = None
        self._there: Circumstances
        if folder is not None:
            from emulator.run.report.content import Circumstances
            from emulator.run.report.observation import Observation

            self._seen, self._there = Observation(rig.camera.size), Circumstances(began)

    def plan(self, scene: Scene, *, is_driven: bool) -> None:
        """Record what the run models, before it begins; raises SceneError."""
        if self._seen is not None:
            from emulator.run.report.modelled import modelled

            self._there = replace(self._there, modelled=modelled(self._rig, scene, is_driven=is_driven))

    def take(self, events: Events, session: Session) -> None:
        """Count the events of a step, and sometimes take a picture."""
        if self._seen is not None:
            self._seen.take(events, session.light, session.t_ns // 1000)

    def renew(self, status: RunStatus) -> None:
        """Record the state of the run."""
        if self._seen is not None:
            self._seen.renew(status)

    def write(self, result: RunResult, summary: Mapping[str, Any], truth_trouble: str = "") -> None:
        """Write the report and name it; where that fails the run's own result still stands.

        A `truth_trouble` makes the run bad.
        """
        if self._folder is None or self._seen is None:
            return
        from emulator.run.report.content import ReportContent
        from emulator.run.report.files import write_report

        judgements = judge(self._rig.verdict, result)
        there = replace(self._there, ended=datetime.now(UTC), truth_trouble=truth_trouble)
        reported = ReportContent(self._rig, result, self._seen, judgements, summary, version("evstim"), there)
        try:
            paths = write_report(reported, self._folder)
        except OSError as error:
            console.print(
                f"--report: {error.strerror or error} ({self._folder}): the report is not whole", markup=False
            )
        else:
            console.print(f"report: {paths[0]}", markup=False)


def begin_report(rig: Rig, folder: Path | None) -> RunReporter:
    """Make the folder, which may exist already, with files that state no verdict; raises Failure."""
    if folder is None:
        return RunReporter(rig, None)
    from emulator.run.report.files import begin_files

    began = datetime.now(UTC)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        begin_files(rig, folder, began)
    except OSError as error:
        raise Failure(f"--report: {folder}: {error.strerror or error}", WRONG_USE) from error
    return RunReporter(rig, folder, began)


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
        from emulator.live_page.messages import ViewerCommands
        from emulator.live_page.page import LivePage

        run = self._rig.run
        can_pause = run.pace == "free" and not run.lockstep_us
        viewer = Operator(session, "live page")
        inject = FaultInjection(self._rig, viewer, None).answer
        commands = ViewerCommands(viewer, inject, self._button(viewer), can_pause=can_pause, repeats=self._repeats)
        try:
            page = LivePage(self._rig, self._address, commands, self._repeats)
        except OSError as error:
            raise Failure(f"--serve: {_shown(self._address)}: {error.strerror or error}", LACKING) from error
        with page:
            status.print(f"live page: {page.url}", markup=False, soft_wrap=True)
            yield page

    def _button(self, viewer: Operator) -> Callable[[int, int], None] | None:
        """Return the trigger, which records its edges; None where there is none."""
        trigger = self._trigger
        if trigger is None:
            return None

        def press(bus_t_ns: int, number: int) -> None:
            early = trigger.early_triggers
            trigger(bus_t_ns, number)
            if trigger.early_triggers == early:
                viewer.record(trigger.last_us, "trigger pulse")

        return press


def check_serving(requested: str | bool | None) -> None:
    """Raise Failure where the requested page cannot be served."""
    if _address(requested) is None:
        return
    from emulator.live_page.page import check_ui

    try:
        check_ui()
    except MachineLacks as error:
        raise Failure(str(error), LACKING) from error


def _address(requested: str | bool | None) -> Address | None:
    if requested is None or requested is False:
        return None
    from emulator.live_page.messages import Address, parse_address

    try:
        return Address() if requested is True else parse_address(requested)
    except ValueError as error:
        raise Failure(f"--serve: {error}", WRONG_USE) from error


def _shown(address: Address) -> str:
    return f"{address.host}:{address.port}"
