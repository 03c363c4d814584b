"""Delivery statistics of one link, for the summary of a run."""

from __future__ import annotations

import dataclasses

from emulator.run.ledger import LinkLedger
from transports.faults.script import FaultRecord
from transports.link.report import LinkReport

__all__ = ["fault_line", "link_json", "link_lines"]

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
        "recordings": [dataclasses.asdict(one) for one in report.recordings],
    }


def link_lines(link: LinkLedger, report: LinkReport) -> list[str]:
    """Return the summary lines on a link's events, the use of its line, its faults and its recordings."""
    lines = [
        f"{link.name}: {link.delivered} delivered (digest {report.digest:08x}), {link.dropped} dropped, "
        f"{link.dropped_in_device} dropped in the device{_causes(report)}"
    ]
    if (use := report.use) is not None:
        lines.append(f"{link.name}: line used {use.share:.1%}, {use.busiest:.1%} in the busiest second")
    told = [f"{count} {name.replace('_', ' ')}" for name, count in report.counts.items() if count]
    if told:
        lines.append(f"{link.name}: {', '.join(told)}")
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


def _causes(report: LinkReport) -> str:
    told = [f"{count} {why}" for cause, why in _CAUSES.items() if (count := getattr(report.camera, cause, 0))]
    return f" ({', '.join(told)})" if told else ""
