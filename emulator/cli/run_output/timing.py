"""Statistics of triggers, of the camera's clock, and of frames and samples, for the summary of a run."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator

from firmware_protocol.readings import ReadingCounters
from transports.link.report import LinkReport

__all__ = ["timing_json", "timing_lines"]


def timing_json(report: LinkReport) -> dict[str, object]:
    """Return the `edges`, `clock` and `readings` of a link for the JSON summary."""
    on_the_way = dataclasses.asdict(report.edges)
    fates = {} if report.camera is None else dataclasses.asdict(report.camera.edges)
    return {
        "edges": {**on_the_way, **fates, "balanced": report.edges_balanced},
        "clock": None if report.clock is None else dataclasses.asdict(report.clock),
        "readings": {kind: _reading_json(report, kind) for kind in report.readings},
    }


def _reading_json(report: LinkReport, kind: str) -> dict[str, object]:
    counted = {} if report.camera is None else report.camera.readings
    fates = dataclasses.asdict(counted.get(kind, ReadingCounters()))
    return {**dataclasses.asdict(report.readings[kind]), **fates, "balanced": report.readings_balanced}


def timing_lines(name: str, report: LinkReport) -> Iterator[str]:
    """Yield a line on the edges, if there were any, and one on the clock, if the camera has its own."""
    if report.camera is not None and report.camera.edges.offered + report.camera.edges.added + report.edges.left:
        e = report.camera.edges
        late = f", {report.edges.late} late by up to {report.edges.worst_late_us} us" if report.edges.late else ""
        left = f", {report.edges.left} came too late for the run" if report.edges.left else ""
        lost = f", {e.lost_on_link} lost on the link" if e.lost_on_link else ""
        yield (
            f"{name}: {e.offered} edges, {e.added} added = {e.delivered} delivered, {e.ignored} not enabled, "
            f"{e.dropped} dropped{lost}{late}{left}"
        )
    if report.edges.marks:
        yield f"{name}: {report.edges.marks} own marks of the camera, {report.edges.marks_sent} sent"
    for kind, fates in () if report.camera is None else report.camera.readings.items():
        gone = fates.dropped + fates.flushed + fates.lost_on_link
        unasked = f"{fates.not_running} not asked for"
        yield f"{name}: {kind}: {fates.offered} readings = {fates.delivered} delivered, {gone} lost, {unasked}"
    if report.clock is not None:
        c = report.clock
        yield f"{name}: camera clock offset {c.offset_us:+.1f} us at {c.t_us * 1e-6:.3f} s, drift {c.ppm:+.3f} ppm"
