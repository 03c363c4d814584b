"""Points of the page's time axis: rates, latencies, frames, inertial samples, triggers and faults over stream time.

One point is made for each status of a run, ten a second. A status contains the points and frames of the last two
seconds, so that a viewer that missed some messages has no gap; it takes those that are newer than its last ones.

The page's process has the points since the start of the run, for viewers that come later or load the page again.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from emulator.run.outcome import RunStatus
from firmware_protocol.device.items import ReadingKind, Readings
from firmware_protocol.frames import LineKind
from firmware_protocol.imu_samples import no_samples, physical
from transports.link.deliveries import LatencySummary
from transports.link.report import LinkReport

_POINTS = 20
_FRAMES = 200
_FAULTS = 30  # of each link
_MOMENTS = (LineKind.START, LineKind.EXPOSURE_START, LineKind.EXPOSURE_END, LineKind.END)


class TimeAxis:
    """Collection of what a run's time axis shows.

    `imu_unit` is the kind of the camera's inertial unit, for its scales, None where it has none; with `has_frames` the
    camera can read frames.
    """

    def __init__(self, imu_unit: int | None, *, has_frames: bool) -> None:
        self._unit, self._has_frames = imu_unit, has_frames
        self._points: deque[dict[str, Any]] = deque(maxlen=_POINTS)
        self._frames: deque[list[float]] = deque(maxlen=_FRAMES)
        self._begun: dict[LineKind, float] = {}
        self._samples: list[Readings] = []
        self._before: RunStatus | None = None

    def take(self, readings: Sequence[tuple[ReadingKind, Readings]]) -> None:
        """Take the readings of a step."""
        for kind, records in readings:
            if kind is ReadingKind.IMU and len(records):
                self._samples.append(records)
            elif kind is ReadingKind.FRAMES and len(records):
                self._take_lines(records)

    def _take_lines(self, records: Readings) -> None:
        moments = records[np.isin(records["kind"], _MOMENTS)]
        for kind, t_us in zip(moments["kind"].tolist(), moments["t"].tolist(), strict=True):
            if kind == LineKind.START:
                self._begun.clear()
            self._begun[LineKind(kind)] = t_us * 1e-6
            if kind == LineKind.END and LineKind.START in self._begun:
                start_s = self._begun[LineKind.START]
                self._frames.append([round(self._begun.get(moment, start_s), 6) for moment in _MOMENTS])
                self._begun.clear()

    def renew(self, status: RunStatus) -> dict[str, Any]:
        """Add a point for a status; return the newest points and frames, and the faults of each link.

        A point has `t_s`, events per second, median and 99th percentile of the latency (us), edges taken since the
        last point, and number and mean rates (deg/s) of the inertial samples since then. A frame has the stream times
        of its start, of the start and the end of its exposure, and of its end, s.
        """
        self._add_point(status)
        newest_s = status.sim_seconds - 2.0
        return {
            "points": list(self._points),
            "frames_read": [frame for frame in self._frames if frame[3] > newest_s],
            "faults": [fault for name, report in status.links.items() for fault in _faults(name, report)],
            "has_frames": self._has_frames,
            "has_imu": self._unit is not None,
        }

    def _add_point(self, status: RunStatus) -> None:
        before, self._before = self._before or status, status
        dt_s = status.sim_seconds - before.sim_seconds
        if dt_s <= 0:
            return
        taken, self._samples = self._samples, []
        samples, mean = np.concatenate([no_samples(), *taken]), None
        if self._unit is not None and len(samples):  # deg/s
            mean = physical(samples, self._unit)["rate_deg_s"].mean(axis=0).round(3).tolist()
        latencies = [report.latency for report in status.links.values() if report.latency.p99 is not None]
        slowest = max(latencies, key=lambda latency: latency.p99 or 0.0, default=LatencySummary())
        self._points.append(
            {
                "t_s": status.sim_seconds,
                "rate": (status.read_out - before.read_out) / dt_s,
                "p50": slowest.p50,
                "p99": slowest.p99,
                "edges": max(0, _edges(status.links) - _edges(before.links)),
                "imu_hz": len(samples) / dt_s,
                "imu": mean,
            }
        )


def _edges(links: Mapping[str, LinkReport]) -> int:
    """Return the edges that the camera with the most of them has taken: an edge goes to all."""
    return max((report.edges.taken for report in links.values()), default=0)


def _faults(name: str, report: LinkReport) -> list[dict[str, Any]]:
    """Return the newest faults of a link, also those of the rig."""
    return [
        {
            "link": name,
            "number": record.number,
            "kind": record.kind,
            "began_s": record.began_us * 1e-6,
            "ended_s": None if record.ended_us is None else record.ended_us * 1e-6,
            "hits": record.hits,
            "events_lost": record.events_lost,
        }
        for record in report.faults[-_FAULTS:]
    ]


_BATCH = 600  # points that become old at once
_MOST_OLDER = 1200
_FIRST_JOINED = 4  # points in an older one; twice as many each time that there are too many older ones
_MOST_FRAMES = 3000


class RunHistory:
    """Points of the time axis since the start of a run, in a memory that does not grow.

    The last minute has every point. Older points are joined: the longer the run, the more of them become one.
    """

    def __init__(self) -> None:
        self._newest: list[dict[str, Any]] = []
        self._older: list[dict[str, Any]] = []
        self._joined = _FIRST_JOINED
        self._frames: deque[list[float]] = deque(maxlen=_MOST_FRAMES)

    def take(self, axis: Mapping[str, Any]) -> bool:
        """Add what is new in a status; return whether points were joined, so that viewers need the history again."""
        last_s = self._newest[-1]["t_s"] if self._newest else -1.0
        self._newest += [point for point in axis["points"] if point["t_s"] > last_s]
        last_s = self._frames[-1][3] if self._frames else -1.0
        self._frames += [frame for frame in axis["frames_read"] if frame[3] > last_s]
        if len(self._newest) < 2 * _BATCH:
            return False
        self._older += _joined(self._newest[:_BATCH], self._joined)
        self._newest = self._newest[_BATCH:]
        if len(self._older) > _MOST_OLDER:
            self._older = _joined(self._older, 2)
            self._joined *= 2
        return True

    def as_json(self) -> dict[str, Any]:
        """Return the points and frames, the oldest first."""
        return {"points": self._older + self._newest, "frames_read": list(self._frames)}


def _joined(points: list[dict[str, Any]], count: int) -> list[dict[str, Any]]:
    """Return points for `count` points each: their edges, their mean rates, and the other values of the last one."""
    parts = [points[first : first + count] for first in range(0, len(points), count)]
    return [{**part[-1], **_sums(part)} for part in parts]


def _sums(points: list[dict[str, Any]]) -> dict[str, Any]:
    sums = {name: sum(point[name] for point in points) for name in ("rate", "imu_hz", "edges")}
    imu = [point["imu"] for point in points if point["imu"] is not None]
    return {
        "rate": sums["rate"] / len(points),
        "imu_hz": sums["imu_hz"] / len(points),
        "edges": sums["edges"],
        "imu": np.mean(imu, axis=0).round(3).tolist() if imu else None,
    }
