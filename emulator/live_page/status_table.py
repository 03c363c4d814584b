"""How a run stands, as the tables that the page shows."""

from __future__ import annotations

from collections import deque
from typing import Any

from emulator.rig.fault_tables import faults_of
from emulator.rig.loading import Rig
from emulator.run.outcome import RunStatus
from transports.link.report import LinkReport

__all__ = ["Rates", "describe", "ledger_table", "status_table"]

_WINDOW = 10  # status reports over which rates are averaged


class Rates:
    """Rates over the last second."""

    def __init__(self) -> None:
        self._past: deque[RunStatus] = deque(maxlen=_WINDOW)

    def renew(self, status: RunStatus) -> dict[str, float]:
        """Return events per second of stream time, and stream seconds per second of time."""
        self._past.append(status)
        first = self._past[0]
        sim_s, wall_s = status.sim_seconds - first.sim_seconds, status.wall_seconds - first.wall_seconds
        return {
            "events_per_s": (status.read_out - first.read_out) / sim_s if sim_s > 0 else 0.0,
            "real_time_factor": sim_s / wall_s if wall_s > 0 else 0.0,
        }


def describe(rig: Rig) -> dict[str, Any]:
    """Return what does not change during a run."""
    width, height = rig.camera.size
    return {
        "name": rig.name,
        "title": rig.title,
        "camera": rig.camera.model,
        "size": [width, height],
        "pace": rig.run.pace,
        "links": {link.name: {"kind": link.kind, "faults": list(faults_of(link))} for link in rig.links},
    }


def status_table(status: RunStatus, rates: dict[str, float]) -> dict[str, Any]:
    """Return what changes during a run."""
    return {
        "t_s": status.sim_seconds,
        "wall_s": status.wall_seconds,
        "frames": status.frames,
        **rates,
        "lateness": status.lateness.as_json(),
        "ledger": ledger_table(status),
        "links": {name: _link(report) for name, report in status.links.items()},
    }


def ledger_table(status: RunStatus) -> dict[str, Any]:
    """Return the fates of all events so far; in each table the parts add up to its whole.

    An event that has no fate yet is `pending` in the sensor, or `on_the_way` to a link or in it. A negative number
    there would be an event with two fates.
    """
    accounted = status.lost_in_pixel + status.lost_at_readout + status.read_out
    return {
        "whole": status.raised,
        "parts": {
            "read_out": status.read_out,
            "pending": status.raised - accounted,
            "lost_at_readout": status.lost_at_readout,
            "lost_in_pixel": status.lost_in_pixel,
        },
        "links": {name: _fates(report, status.read_out) for name, report in status.links.items()},
    }


def _fates(report: LinkReport, read_out: int) -> dict[str, Any]:
    parts = {
        "delivered": report.delivered,
        "on_the_way": read_out - report.delivered - report.dropped - report.dropped_in_device,
        "dropped_in_device": report.dropped_in_device,
        "dropped": report.dropped,
    }
    return {"whole": read_out, "parts": parts}


def _link(report: LinkReport) -> dict[str, Any]:
    latency = report.latency
    return {
        "state": report.state,
        "address": report.address,
        "error": report.error,
        "latency_us": [latency.p50, latency.p99, latency.max],
        "edges": report.edges.taken,
        "faults": len(report.faults),
        "events_lost_by_faults": sum(fault.events_lost for fault in report.faults),
    }
