"""Lines and JSON of the summary of a run, and the files of its options `--truth` and `--trace`.

The summary has the deliveries and latencies of each link, its triggers, clock, frames and samples; the lateness of the
run, with advice when it did not keep up with the clock; and changes from outside.

`--truth FILE`: a .csv for the camera's clock, an .h5 for the scene and the sensor; by the suffix.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, nullcontext
from pathlib import Path
from typing import Any

from emulator.cli.checks import check_output
from emulator.cli.output import LACKING, WRONG_USE, Failure, failing, status
from emulator.rig.loading import Rig
from emulator.run.kernels import TRUTH, Part
from emulator.run.link_process import traced
from emulator.run.outcome import Judgement, LinkLedger, RunResult
from firmware_protocol.device.fates import Counts
from transports.faults.script import FaultRecord
from transports.link.deliveries import LatencySummary
from transports.link.process import LinkSetup
from transports.link.report import LinkReport

_CAUSES = {
    "not_running": "no host was streaming",
    "not_selected": "not selected",
    "dropped_background": "background activity",
    "dropped_refractory": "within the refractory period",
    "dropped_rate": "over the rate limit",
    "dropped_late": "too late",
    "dropped_fifo": "FIFO full",
    "flushed": "flushed at a stop",
}


def link_json(report: LinkReport) -> dict[str, object]:
    """Return the drop causes, line use, counts, faults and recordings of a link, for `run --json`."""
    camera = report.camera
    dropped = {} if camera is None else {cause: getattr(camera, cause) for cause in _CAUSES}
    return {
        "dropped_in_device": dropped,
        "use": None if report.use is None else dataclasses.asdict(report.use),
        "counts": dict(report.counts),
        "faults": [dataclasses.asdict(fault) for fault in report.faults],
        "recordings": [dataclasses.asdict(recording) for recording in report.recordings],
    }


def link_lines(link: LinkLedger, report: LinkReport) -> list[str]:
    """Return the summary lines on a link's events, the use of its line, its faults and its recordings."""
    causes = [f"{count} {reason}" for cause, reason in _CAUSES.items() if (count := getattr(report.camera, cause, 0))]
    named = f" ({', '.join(causes)})" if causes else ""
    lines = [
        f"{link.name}: {link.delivered} delivered (digest {report.digest:08x}), {link.dropped} dropped, "
        f"{link.dropped_in_device} dropped in the device{named}"
    ]
    if (use := report.use) is not None:
        lines.append(f"{link.name}: line used {use.share:.1%}, {use.busiest:.1%} in the busiest second")
    counts = [f"{count} {name.replace('_', ' ')}" for name, count in report.counts.items() if count]
    if counts:
        lines.append(f"{link.name}: {', '.join(counts)}")
    lines += [f"{link.name}: {fault_line(fault)}" for fault in report.faults]
    lines += [f"{link.name}: {line}" for recording in report.recordings for line in recording.lines]
    return lines


def fault_line(fault: FaultRecord) -> str:
    """Return a line on a fault: its time, hits and losses."""
    ended = "the end" if fault.ended_us is None else f"{fault.ended_us * 1e-6:.3f} s"
    edges = f" and {fault.edges_lost} edges" if fault.edges_lost else ""
    return (
        f"fault {fault.number}, {fault.kind}, {fault.began_us * 1e-6:.3f} s to {ended}: {fault.hits} hits, "
        f"{fault.touched} units affected, {fault.events_lost} events{edges} lost"
    )


def quantile_text(value_us: float | None) -> str:
    """Return a quantile of latencies, us; "-" where nothing was measured."""
    return "-" if value_us is None else f"{value_us:.0f}"


def latency_text(latency: LatencySummary) -> str:
    """Return the quantiles and the largest of measured latencies, us."""
    return f"p50 {quantile_text(latency.p50)} us, p99 {quantile_text(latency.p99)} us, max {latency.max or 0:.0f} us"


_REPORTED_LATENESS_US = 1000.0
_BUSY = 0.75  # share of the processor: 0.78 to 0.91 on two idle cores, 0.44 to 0.65 beside a busy loop, 0.5 on one core


def verdict_line(rules: Sequence[Judgement]) -> str:
    """Return the last line of a summary: whether the run was good, else the rules that it broke."""
    broken = [rule.rule for rule in rules if not rule.good]
    if not broken:
        return f"good: {len(rules)} of {len(rules)} rules kept"
    return f"NOT GOOD: {len(broken)} of {len(rules)} rules broken: {', '.join(broken)}"


def lateness_lines(rig: Rig, result: RunResult) -> list[str]:
    """Return no line for a run that kept up, else its lateness and the remedies."""
    late, run = result.lateness, rig.run
    if result.too_late:
        worst = f"the worst step was {late.worst_gap_us / 1e6:.3g} s late, and run.max_late_ms is {run.max_late_ms:g}"
        often = f"{late.frames_late} of {result.steps} steps ({result.late_share:.1%}) were late"
        often = f"{often}, and run.max_late_share is {run.max_late_share:g}"
        broken = "; ".join([worst] * result.step_too_late + [often] * result.late_too_often)
        return [f"NOT IN REAL TIME: {broken}. {_remedies(rig, late.processor_share)}"]
    if late.worst_gap_us > _REPORTED_LATENESS_US or result.often_stretched:
        return [
            f"late: {late.frames_late} of {result.steps} steps, the worst by {late.worst_gap_us:.0f} us; "
            f"{late.steps_stretched} steps made longer to keep up"
        ]
    return []


def _remedies(rig: Rig, processor_share: float) -> str:
    """Return what makes a late run faster: another rig helps little where other programs have the processor."""
    if processor_share < _BUSY:
        return (
            f"Other programs had the processor for {1 - processor_share:.0%} of the time in which steps were computed: "
            "end them, or take a machine with more cores; the rig need not change"
        )
    longer = f"a longer run.step_us (now {rig.run.step_us}) or run.lead_us (now {rig.run.lead_us})"
    return f"Take {longer}, fewer scene.samples, or a smaller camera; `evstim plan` shows the cost of each"


def timing_json(report: LinkReport) -> dict[str, object]:
    """Return the `edges`, `clock` and `readings` of a link for the JSON summary."""
    edges = dataclasses.asdict(report.edges)
    if report.camera is not None:
        c = report.camera.edges
        edges |= {"offered": c.offered, "ignored": c.ignored, "dropped": c.dropped_for_room, "delivered": c.delivered}
        edges |= {"queued": c.queued, "lost_on_link": c.lost_on_link, "added": c.added}
    readings = {}
    for kind, reading in report.readings.items():
        c = Counts() if report.camera is None else report.camera.readings.get(kind, Counts())
        readings[kind] = dataclasses.asdict(reading) | {
            "offered": c.offered, "not_running": c.not_running, "dropped": c.dropped_fifo, "flushed": c.flushed,
            "delivered": c.delivered, "lost_on_link": c.lost_on_link, "queued": c.queued,
            "balanced": report.readings_balanced,
        }  # fmt: skip
    return {
        "edges": {**edges, "balanced": report.edges_balanced},
        "clock": None if report.clock is None else dataclasses.asdict(report.clock),
        "readings": readings,
    }


def timing_lines(name: str, report: LinkReport) -> Iterator[str]:
    """Yield a line on the edges, if there were any, and one on the clock, if the camera has its own."""
    if report.camera is not None and report.camera.edges.offered + report.camera.edges.added + report.edges.left:
        e = report.camera.edges
        late = f", {report.edges.late} late by up to {report.edges.worst_late_us} us" if report.edges.late else ""
        left = f", {report.edges.left} came too late for the run" if report.edges.left else ""
        lost = f", {e.lost_on_link} lost on the link" if e.lost_on_link else ""
        yield (
            f"{name}: {e.offered} edges, {e.added} added = {e.delivered} delivered, {e.ignored} not enabled, "
            f"{e.dropped_for_room} dropped{lost}{late}{left}"
        )
    if report.edges.marks:
        yield f"{name}: {report.edges.marks} own marks of the camera, {report.edges.marks_sent} sent"
    for kind, fates in () if report.camera is None else report.camera.readings.items():
        gone = fates.dropped_for_room + fates.lost_on_link
        unrequested = f"{fates.not_running} not requested"
        yield f"{name}: {kind}: {fates.offered} readings = {fates.delivered} delivered, {gone} lost, {unrequested}"
    if report.clock is not None:
        c = report.clock
        yield f"{name}: camera clock offset {c.offset_us:+.1f} us at {c.t_us * 1e-6:.3f} s, drift {c.ppm:+.3f} ppm"


class Truth:
    """The truth files of a run, checked; raises Failure.

    Attributes
    ----------
    clock : the file for the error of the camera's clock.
    """

    def __init__(self, rig: Rig, path: Path | None, every: int | None) -> None:
        self.clock = path
        self._file: Any = None
        if path is None:
            return
        from emulator.run.truth.source import SUFFIXES

        if path.suffix in SUFFIXES:
            self._file, self.clock = _truth_file(rig, path, every), None
        elif rig.camera.clock is None or not rig.links:
            raise Failure(
                "--truth: give an .h5 file for the truth of scene and sensor; any other file is for the error of the "
                "camera's clock: this rig needs a [camera.clock] table and a link that carries its times",
                WRONG_USE,
            )
        check_output("--truth", path)

    @property
    def parts(self) -> list[Part]:
        """Kernels of the truth, beside the rig's own parts."""
        return [] if self._file is None else [TRUTH]

    @property
    def trouble(self) -> str:
        """Reason why the file is not complete; "" where it is, or where there is none."""
        return "" if self._file is None else self._file.trouble

    def begin(self) -> AbstractContextManager[Any]:
        """Return the context of the truth file, for `build_session`; its value is None without a file."""
        return nullcontext() if self._file is None else self._file


def _truth_file(rig: Rig, path: Path, every: int | None) -> Any:
    from emulator.run.truth.source import TruthFile, TruthRefused, TruthSelection

    selection = TruthSelection(every)
    with failing(WRONG_USE, TruthRefused, at="--truth"), failing(LACKING, ImportError, at="--truth"):
        file = TruthFile(rig, path, selection)
    rate_hz, bytes_a_second = selection.pictures(rig)
    size = f"{bytes_a_second * (rig.run.seconds or 1) / 1e6:.2g} MB{'' if rig.run.seconds else ' a second'}"
    status.print(f"truth: {rate_hz:g} light frames a second, at most {size} of them in {path}", markup=False)
    return file


def begin_trace(setups: Sequence[LinkSetup[Any]], path: Path | None) -> list[LinkSetup[Any]]:
    """Return the links, with a trace of their USB cables in new files; raises Failure."""
    if path is None:
        return list(setups)
    from transports.usb.usbip.trace import both_files

    links, traces = traced(setups, path)
    if not traces:
        raise Failure("--trace: this rig has no link of kind usbip, so there is no USB cable to trace", WRONG_USE)
    for file in [file for trace in traces for file in both_files(trace)]:
        check_output("--trace", file)
        if file.is_file():
            file.write_bytes(b"")
    return links


_MOST = 20


def changes_lines(result: RunResult) -> list[str]:
    """Return no line for a run that follows from its rig and seed alone, else each change with its origin and time."""
    count = len(result.changes) + result.changes_beyond
    if not count:
        return []
    lines = [f"changed from outside {count} times; the rig and its seed alone do not repeat this run:"]
    lines += [f"  {change.text}" for change in result.changes[:_MOST]]
    return lines if count <= _MOST else [*lines, f"  and {count - _MOST} more: --json and --report list them"]
