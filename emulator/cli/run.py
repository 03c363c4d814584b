"""`evstim run RIG`."""

from __future__ import annotations

import dataclasses
import errno
import shutil
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from cyclopts import Parameter

from emulator.cli import restore_collection, run_summary
from emulator.cli.checks import check_output, failures, prepared
from emulator.cli.output import (
    BAD_VERDICT,
    GOOD,
    LACKING,
    WRONG_USE,
    Failure,
    Json,
    RigName,
    console,
    failing,
    print_result,
    status,
)
from emulator.cli.run_display import LiveTable, OptionalPage, begin_report, check_serving, end_report
from emulator.cli.run_summary import Truth
from emulator.cli.signals import ignore_stop_signals, interrupt_on_stop_signals, stop_on_signals
from emulator.light import Scene
from emulator.rig.loading import Rig, load_rig, with_options
from emulator.rig.remarks import remarks
from emulator.run.assembly import build_scene, build_session, link_setups, loads_of, plan_of, schedule
from emulator.run.control import ReadySignal, fault_injection
from emulator.run.kernels import parts_of
from emulator.run.outcome import RunResult, RunStatus, good, judge, undersampled_advice
from emulator.run.pacing import SimulationDrive
from emulator.run.session import Session
from firmware_protocol.events import Events
from transports.link.deliveries import LatencySummary
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup

if TYPE_CHECKING:
    from emulator.live_page.controls import Repeats
    from emulator.run.report.files import RunReporter


@Parameter(name="*")
@dataclass(frozen=True)
class Files:
    """Files that a run writes.

    Attributes
    ----------
    record
        Write the delivered events to this file, in device time; its suffix gives the format, such as .aedat4, .raw
        or .npz: see docs/recordings.md. Of several links each has a file, NAME-LINK.SUFFIX; a link that was started
        again writes NAME-restart1.SUFFIX, and when a camera's clock is reset NAME-clock2.SUFFIX follows (not .npz).
    truth
        Write the truth beside the events to this .h5: light, depth, optical flow, poses, labels, the origin of each
        event, the events of an ideal sensor; see docs/recordings.md. Or the true error of the camera's clock to this
        .csv, ten lines per second; the rig needs [camera.clock]. Of several links each has a .csv, NAME-LINK.csv.
    truth_every
        Light, depth, flow and labels of every n-th light frame go into the .h5; by default of 25 a second.
    fault_log
        Write a line of JSON to this file for each begin, hit, loss and end of a fault.
    ready_file
        Write a line of JSON with each link's address to this file when the run has begun.
    trace
        Write every URB of a USB/IP link to FILE.txt, with requests by name, and to FILE.pcap for Wireshark.
    report
        Write report.html, report.json and junit.xml into this folder when the run has ended.
    serve
        Serve a live page at [HOST:PORT], unless given at 127.0.0.1 and a free port; elsewhere with a token.
    """

    record: Path | None = None
    truth: Path | None = None
    truth_every: int | None = None
    fault_log: Path | None = None
    ready_file: Path | None = None
    trace: Path | None = None
    report: Path | None = None
    serve: str | bool | None = None


NO_FILES = Files()


def run(
    rig: RigName,
    /,
    *,
    seconds: float | None = None,
    seed: int | None = None,
    pace: Literal["realtime", "free"] | None = None,
    files: Files = NO_FILES,
    json: Json = False,
) -> int:
    """Run a rig: render its scene, simulate its sensor, serve its links. Ctrl-C ends the run with its summary.

    Parameters
    ----------
    seconds
        Stream time to run for; 0: until Ctrl-C. Default: the rig's.
    seed
        Seed of everything random. Default: the rig's.
    pace
        realtime: every event leaves at its own time; free: as fast as possible, without loss.
    """
    with failures():
        loaded = rig_with_options(load_rig(rig), seconds, seed, pace)
        repeats = _repeats(files)
        parts = RunParts(repeats=repeats)
        result, truth = run_with_files(loaded, files, parts, show=not json)
        # A viewer of the live page sends a seed for a further run.
        while repeats is not None and (next_seed := repeats.take(loaded, result)) is not None:
            for line in () if json else summary_lines(loaded, result):
                console.print(line, markup=False)
            interrupt_on_stop_signals()
            loaded = rig_with_options(loaded, None, next_seed, None)
            result, truth = run_with_files(loaded, files, parts, show=not json)
    value = {**summary(loaded, result), "truth_trouble": truth.trouble}
    print_result(json, value, summary_lines(loaded, result, truth.trouble))
    return GOOD if good(judge(loaded.verdict, result)) and not truth.trouble else BAD_VERDICT


def _repeats(files: Files) -> Repeats | None:
    """Return the receiver of requests to start the run again; one for a run that writes files refuses them."""
    if not files.serve:
        return None
    from emulator.live_page.controls import Repeats

    written = {"record": files.record, "truth": files.truth, "fault-log": files.fault_log, "trace": files.trace}
    written |= {"report": files.report, "ready-file": files.ready_file}
    options = [f"--{name}" for name, path in written.items() if path is not None]
    return Repeats(f"the new run would write over the files of {', '.join(options)}" if options else "")


def run_with_files(rig: Rig, files: Files, parts: RunParts | None = None, *, show: bool) -> tuple[RunResult, Truth]:
    """Check that the files can be written, compile the kernels, run a rig and report; raises Failure."""
    if files.record is not None:
        from emulator.cli.recordings import check_record

        check_record(rig, files.record)
    truth = Truth(rig, files.truth, files.truth_every)
    check_output("--ready-file", files.ready_file)
    check_serving(files.serve)
    if files.fault_log is not None:  # every link appends to it
        with failing(WRONG_USE, OSError, at=f"--fault-log: {files.fault_log}"):
            files.fault_log.write_bytes(b"")
    reporting = begin_report(rig, files.report)
    prepared([*parts_of(rig), *truth.parts])
    parts = dataclasses.replace(parts or RunParts(), reporting=reporting, truth=truth)
    result = run_rig(rig, files, parts, show=show)
    ignore_stop_signals()
    if reporting is not None:
        end_report(reporting, result, summary(rig, result), truth.trouble)
    return result, truth


def rig_with_options(rig: Rig, seconds: float | None, seed: int | None, pace: str | None) -> Rig:
    """Return the rig with the options of a command; raises Failure."""
    try:
        return with_options(rig, seconds, seed, pace)
    except ValueError as error:
        raise Failure(f"--{error}", WRONG_USE) from error


@dataclass(frozen=True)
class RunParts:
    """Parts that take part in a run.

    Attributes
    ----------
    reporting, truth
        Those of the run's files; None: without a report, and as in the files.
    simulation
        A simulation with which the run is in step; None: none.
    repeats
        Receiver of a viewer's request to start the run again; None: it cannot be started again.
    follow
        Function that is called with the session and each status of the run; None: none.
    """

    reporting: RunReporter | None = None
    truth: Truth | None = None
    simulation: SimulationDrive | None = None
    repeats: Repeats | None = None
    follow: Callable[[Session, RunStatus], None] | None = None


def run_rig(rig: Rig, files: Files = NO_FILES, parts: RunParts | None = None, *, show: bool = False) -> RunResult:
    """Run a loaded rig, with a live table on stderr when `show`."""
    parts = parts or RunParts()
    reporting, simulation = parts.reporting, parts.simulation
    truth = parts.truth or Truth(rig, files.truth, files.truth_every)
    with build_scene(rig) as scene, truth.begin() as truth_file:
        for line in _first_lines(rig, scene, is_driven=simulation is not None) if show else ():
            console.print(line, markup=False)
        if reporting:
            reporting.plan(scene, is_driven=simulation is not None)
        serving = OptionalPage(rig, files.serve, parts.repeats)
        setups = serving.wired(link_setups(rig, files.record, truth.clock, files.fault_log))
        setups = run_summary.begin_trace(setups, files.trace)
        session = _session(rig, scene, setups, truth_file)
        stop_on_signals(partial(_stop, session, parts.repeats), session.interrupt, session.end_step)
        with (
            fault_injection(rig, session) as faults,
            serving.page(session) as page,
            LiveTable(rig, status) if show else nullcontext() as live,
        ):
            if show and faults.trouble:
                console.print(f"note: {faults.trouble}")

            ready = ReadySignal(files.ready_file)

            def report(now: RunStatus) -> None:
                with failing(LACKING, OSError, at="--ready-file"):
                    ready.send({name: link.address for name, link in now.links.items()})
                faults.serve(now)
                if parts.follow:
                    parts.follow(session, now)
                if reporting:
                    reporting.seen.renew(now)
                if page:
                    page.renew(now)
                if live:
                    live.update(now)

            def take(events: Events) -> None:
                t_us = session.t_ns // 1000
                if reporting:
                    reporting.seen.take(events, session.light, t_us)
                if page:
                    page.show(events, session.light, t_us, session.last_readings)
                if simulation is not None:
                    simulation.take(events)

            restore_collection()
            return session.run(dataclasses.replace(schedule(rig), simulation=simulation), report, take)


def _first_lines(rig: Rig, scene: Scene, *, is_driven: bool) -> Iterator[str]:
    """Yield whether a run is too slow here, its renderer, remarks, and each line that carries not all expected events.

    A run in real time is tried before; that of poses or light from outside is not.
    """
    if rig.run.pace == "realtime" and not is_driven:
        from emulator.run.trial import runs_alone, trial

        if runs_alone(rig):
            speed = trial(rig, scene, plan_of(rig, scene) if rig.run.tolerance_us else None)
            if speed.factor < 1:
                yield f"{rig.name} {speed.verdict(rig)}"
    if scene.renderer:
        yield f"renderer: {scene.renderer}"
    yield from (f"note: {note}" for note in (*remarks(rig), *scene.notes))
    for load in loads_of(rig, None if is_driven else scene):
        if load.share is not None and load.share < 1:
            yield f"note: {load.line}"


def _stop(session: Session, repeats: Repeats | None) -> None:
    """End a run, and all that a viewer has requested to follow it."""
    if repeats is not None:
        repeats.cancel()
    session.stop()


def _session(rig: Rig, scene: Scene, setups: list[LinkSetup[Any]], truth: Any) -> Session:
    try:
        return build_session(rig, scene, setups, MonotonicClock(), truth)
    except OSError as error:
        text = f"--truth: {error.filename}: {error.strerror or error}"
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG):
            raise Failure(text, WRONG_USE) from error
        free_mb = shutil.disk_usage(Path(error.filename).parent).free / 1e6
        raise Failure(f"{text}: {free_mb:.1f} MB free; free more, or name a file on another disk", LACKING) from error


def summary(rig: Rig, result: RunResult) -> dict[str, object]:
    """Return the object that `run --json` prints; its latency is that of the slowest link, which no other one hides."""
    measured = [report.latency for report in result.links.values() if report.latency.p99 is not None]
    slowest = max(measured, key=lambda latency: latency.p99 or 0.0, default=LatencySummary())
    return {
        "rig": rig.name,
        "sim_seconds": result.sim_seconds,
        "wall_seconds": result.wall_seconds,
        "frames": result.frames,
        "steps": result.steps,
        "events": result.ledger.as_json(),
        "balanced": result.ledger.balanced,
        "rules": [rule.as_json() for rule in judge(rig.verdict, result)],
        "latency_us": dataclasses.asdict(slowest),
        "lateness": {**result.lateness.as_json(), "late_share": result.late_share, "too_late": result.too_late},
        "undersampled_share": result.undersampled_share,
        "scene": result.scene_counts,
        "painter": result.painter,
        "renderer": result.renderer,
        "syncs": result.syncs,
        "changes": [change.as_json() for change in result.changes],
        "changes_beyond": result.changes_beyond,
        "links": {
            name: {
                "state": r.state,
                "latency_us": r.latency,
                "digest": r.digest,
                "error": r.error,
                "file_troubles": r.file_troubles,
                **run_summary.link_json(r),
                **run_summary.timing_json(r),
            }
            for name, r in result.links.items()
        },
    }


# Rules whose finding no other line of the summary has.
_SHOWN = ("verdict.", "scene")


def summary_lines(rig: Rig, result: RunResult, truth_trouble: str = "") -> Iterator[str]:
    """Yield the summary of a run, for people, with the reason why its truth file is not whole."""
    ledger, syncs = result.ledger, "" if result.syncs is None else f", {result.syncs} SYNCs"
    yield (
        f"{rig.name}: {result.sim_seconds:.3f} s of stream time in {result.wall_seconds:.3f} s, "
        f"{result.frames} frames, {result.steps} steps{syncs}"
    )
    yield f"drawn by {result.drawn_by}"
    yield (
        f"events: {ledger.raised} raised = {ledger.lost_in_pixel} lost in the pixel + {ledger.lost_at_readout} lost at "
        f"the read-out + {ledger.read_out} read out"
    )
    for link in ledger.links:
        report = result.links[link.name]
        yield from run_summary.link_lines(link, report)
        if report.error is not None:
            yield f"{link.name}: {report.error}"
        yield from (f"{link.name}: {trouble}" for trouble in report.file_troubles)
        yield from run_summary.timing_lines(link.name, report)
        if report.latency.p50 is not None:
            yield f"{link.name}: event to socket {run_summary.latency_text(report.latency)}"
    if advice := undersampled_advice(result):
        yield advice
    if result.scene_counts:
        yield f"scene: {', '.join(f'{n} {name}' for name, n in result.scene_counts.items())}"
    yield from run_summary.changes_lines(result)
    yield from run_summary.lateness_lines(rig, result)
    rules = judge(rig.verdict, result)
    for broken in (rule for rule in rules if not rule.good and rule.rule.startswith(_SHOWN)):
        yield f"NOT GOOD: {broken.rule}: {broken.finding}"
    yield "ledger: balanced" if ledger.balanced else f"ledger: OFF BY {ledger.imbalance} EVENTS"
    yield run_summary.verdict_line(rules)
    if truth_trouble:
        yield f"--truth: {truth_trouble}"
