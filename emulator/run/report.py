"""The report of a run as files: report.html (one page, nothing to download), report.json and junit.xml.

The observation of a run takes memory that does not grow with its events:

per pixel   ON and OFF events
per bin     events and ON events in each tenth of a second of stream time, later in longer bins
intervals   between two events of the same pixel, of one pixel in eight, in bins of a tenth of a decade
links       delivered and dropped, at each status of the run

junit.xml has the verdict in the XML that CI systems read: each
rule is a test case (the JUnit schema of Apache Ant).
"""

from __future__ import annotations

import os
import platform
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np
import numpy.typing as npt

from emulator.report.page import BLUE, INK, RED, Page, image, pyplot, svg, write_json
from emulator.rig.loading import Rig
from emulator.run.outcome import Judgement, RunResult, RunStatus, good, undersampled_advice, undersampled_text
from firmware_protocol.events import Events

__all__ = [
    "INTERVAL_EDGES_US",
    "Observation",
    "RateSeries",
    "ReportContent",
    "interval_chart",
    "pixel_map",
    "rate_chart",
    "write_junit",
    "write_report",
]


_BIN_US = 100_000
_MOST_BINS = 2000
_SAMPLED = 8  # one pixel in so many
INTERVAL_EDGES_US = np.logspace(0, 8, 81)
"""Edges of the bins of intervals, us."""


class RateSeries:
    """Events in bins of stream time: when there are too many bins, each two become one.

    Attributes
    ----------
    bin_us : length of a bin now.
    """

    def __init__(self) -> None:
        self.bin_us = _BIN_US
        self._events = np.zeros(_MOST_BINS, np.int64)
        self._on = np.zeros(_MOST_BINS, np.int64)
        self._used = 0

    def add(self, events: Events) -> None:
        """Count events (n,) EVENT, n > 0, sorted by time."""
        while int(events["t"][-1]) // self.bin_us >= _MOST_BINS:
            self._halve()
        bins = (events["t"] // self.bin_us).astype(np.int64)
        first = int(bins[0])
        counts = np.bincount(bins - first)
        self._events[first : first + len(counts)] += counts
        self._on[first : first + len(counts)] += np.bincount(bins - first, events["on"]).astype(np.int64)
        self._used = max(self._used, first + len(counts))

    @property
    def events(self) -> npt.NDArray[np.int64]:
        """Events in each bin, (n,)."""
        return self._events[: self._used]

    @property
    def on(self) -> npt.NDArray[np.int64]:
        """ON events in each bin, (n,)."""
        return self._on[: self._used]

    def _halve(self) -> None:
        for counts in (self._events, self._on):
            counts[: _MOST_BINS // 2] = counts.reshape(-1, 2).sum(axis=1)
            counts[_MOST_BINS // 2 :] = 0
        self._used = (self._used + 1) // 2
        self.bin_us *= 2


class Observation:
    """Statistics of the events and the statuses of a run.

    Parameters
    ----------
    size : (width, height) of the sensor, pixels.

    Attributes
    ----------
    on, off : events of each pixel, (height, width) int64.
    rates : events over time.
    intervals : how many intervals lie in each bin of INTERVAL_EDGES_US.
    worst_late_us : at each status, (stream time in s, worst lateness so far in us).
    """

    def __init__(self, size: tuple[int, int]) -> None:
        width, height = size
        self.on = np.zeros((height, width), np.int64)
        self.off = np.zeros((height, width), np.int64)
        self.rates = RateSeries()
        self.intervals = np.zeros(len(INTERVAL_EDGES_US) - 1, np.int64)
        self.worst_late_us = 0.0
        self._last_us = np.full(width * height, -1, np.int64)
        self._width = width

    def take(self, events: Events) -> None:
        """Count the events (n,) EVENT of a step, sorted by time."""
        if not len(events):
            return
        self.rates.add(events)
        pixel = events["y"].astype(np.int64) * self._width + events["x"]
        for counts, chosen in ((self.on, events["on"]), (self.off, ~events["on"])):
            counts.ravel()[:] += np.bincount(pixel[chosen], minlength=counts.size)
        sampled = (events["x"] + events["y"]) % _SAMPLED == 0
        self._measure(pixel[sampled], events["t"][sampled].astype(np.int64))

    def renew(self, status: RunStatus) -> None:
        """Record the state of the run."""
        self.worst_late_us = max(self.worst_late_us, status.lateness.worst_gap_us)

    def _measure(self, pixel: npt.NDArray[np.int64], t_us: npt.NDArray[np.int64]) -> None:
        """Add the intervals that end with these events."""
        if not len(pixel):
            return
        order = np.argsort(pixel, kind="stable")
        pixel, t_us = pixel[order], t_us[order]
        before = np.empty_like(t_us)
        before[1:] = t_us[:-1]
        first = np.concatenate([[True], pixel[1:] != pixel[:-1]])
        before[first] = self._last_us[pixel[first]]
        last = np.concatenate([first[1:], [True]])
        self._last_us[pixel[last]] = t_us[last]
        known = before >= 0
        self.intervals += np.histogram(np.maximum(t_us - before, 1)[known], INTERVAL_EDGES_US)[0]


def rate_chart(seen: Observation, seconds: float) -> str:
    """Return the event rate over the whole bins of stream time in a run of `seconds`, an <svg> element."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 2.6))
    bin_s = seen.rates.bin_us * 1e-6
    whole = max(1, int(seconds / bin_s + 1e-9))
    on, every = seen.rates.on[:whole], seen.rates.events[:whole]
    edges_s = np.arange(len(every) + 1) * bin_s
    axes.stairs(on / bin_s * 1e-3, edges_s, color=RED, label="ON")
    axes.stairs((every - on) / bin_s * 1e-3, edges_s, color=BLUE, label="OFF")
    axes.set(xlabel="stream time, s", ylabel="kev/s", title=f"event rate, in bins of {bin_s:g} s")
    axes.set_ylim(bottom=0)
    axes.legend(frameon=False)
    return svg(figure)


def interval_chart(seen: Observation) -> str:
    """Return the histogram of intervals between events of one pixel, an <svg> element."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 2.6))
    axes.stairs(seen.intervals, INTERVAL_EDGES_US, color=INK)
    axes.set(xscale="log", xlabel="us", ylabel="intervals", title="time between two events of a pixel (1 pixel in 8)")
    return svg(figure)


def pixel_map(seen: Observation) -> str:
    """Return the events of each pixel as an <img> element that holds its own data."""
    plt = pyplot()
    figure, axes = plt.subplots(figsize=(9, 5))
    shown = axes.imshow(np.log10(1 + seen.on + seen.off), cmap="cividis", interpolation="nearest")
    figure.colorbar(shown, ax=axes, label="log10(1 + events)")
    axes.set_title("events of each pixel")
    return image(figure, "events of each pixel")


def write_junit(rig: str, judgements: tuple[Judgement, ...], seconds: float, path: Path) -> Path:
    """Write one test suite named after the rig; return the path."""
    failed = sum(not one.good for one in judgements)
    counts = {"tests": str(len(judgements)), "failures": str(failed), "errors": "0", "time": f"{seconds:.3f}"}
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {"name": f"evstim {rig}", **counts})
    for one in judgements:
        case = ElementTree.SubElement(suite, "testcase", {"classname": f"evstim.{rig}", "name": one.rule, "time": "0"})
        if one.good:
            ElementTree.SubElement(case, "system-out").text = one.finding
        else:
            ElementTree.SubElement(case, "failure", {"message": one.finding}).text = one.finding
    ElementTree.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)
    return path


@dataclass(frozen=True)
class ReportContent:
    """Content of a report.

    Attributes
    ----------
    summary : object that `evstim run --json` prints.
    version : of evstim.
    """

    rig: Rig
    result: RunResult
    seen: Observation
    judgements: tuple[Judgement, ...]
    summary: Mapping[str, Any]
    version: str


def write_report(of: ReportContent, folder: Path) -> list[Path]:
    """Write the three files into a folder that exists; return their paths. Raises OSError and ChartsLacking."""
    verdict = "good" if good(of.judgements) else "bad"
    page = Page(f"{of.rig.name}: {verdict}")
    page.table([{"rule": one.rule, "kept": "yes" if one.good else "NO", "found": one.finding} for one in of.judgements])
    page.text(undersampled_advice(of.result.undersampled_share) or "")
    page.heading("Events").chart(rate_chart(of.seen, of.result.sim_seconds)).table(_fates(of.result))
    page.chart(interval_chart(of.seen)).chart(pixel_map(of.seen))
    _add_links(page, of.result)
    _add_changes(page, of.result)
    page.heading("Run").facts(_facts(of))
    numbers = {"verdict": verdict, "rules": [one.as_json() for one in of.judgements], **of.summary, "run": _machine(of)}
    return [
        page.write(folder / "report.html"),
        write_json(msgspec.to_builtins(numbers), folder / "report.json"),
        write_junit(of.rig.name, of.judgements, of.result.wall_seconds, folder / "junit.xml"),
    ]


def _fates(result: RunResult) -> list[dict[str, object]]:
    """Return the fates of the events: of the sensor, and of each link."""
    ledger = result.ledger
    rows: list[dict[str, object]] = [
        {"where": "sensor", "fate": "lost in the pixel", "events": ledger.lost_in_pixel},
        {"where": "sensor", "fate": "lost at the read-out", "events": ledger.lost_at_readout},
        {"where": "sensor", "fate": "read out", "events": ledger.read_out},
    ]
    for link in ledger.links:
        fates = {"delivered": link.delivered, "dropped by the link": link.dropped}
        fates |= _in_device(result, link.name)
        rows += [
            {"where": link.name, "fate": fate, "events": n} for fate, n in fates.items() if n or fate == "delivered"
        ]
    return rows


def _in_device(result: RunResult, name: str) -> dict[str, int]:
    camera = result.links[name].camera
    if camera is None:
        return {}
    causes = (
        *("not_running", "not_selected", "dropped_background", "dropped_refractory"),
        *("dropped_rate", "dropped_late", "dropped_fifo", "flushed"),
    )
    return {f"in the camera: {cause.replace('_', ' ')}": getattr(camera, cause) for cause in causes}


def _add_links(page: Page, result: RunResult) -> None:
    page.heading("Links").text("" if result.links else "none")
    page.table(
        [
            {
                "link": name,
                "state": link.state,
                "digest": f"{link.digest:08x}",
                "latency p50, us": link.latency.p50,
                "p99, us": link.latency.p99,
                "max, us": link.latency.max,
                "line used": None if link.use is None else link.use.share,
                "clock offset, us": None if link.clock is None else link.clock.offset_us,
                "clock drift, ppm": None if link.clock is None else link.clock.ppm,
            }
            for name, link in result.links.items()
        ]
    )
    faults = [
        {
            "link": name,
            **{key: value if isinstance(value, float | int) else str(value) for key, value in asdict(f).items()},
        }
        for name, link in result.links.items()
        for f in link.faults
    ]
    if faults:
        page.heading("Faults", 3).table(faults)


def _add_changes(page: Page, result: RunResult) -> None:
    """Add the changes from outside; nothing where there are none."""
    if not result.changes:
        return
    rows = [
        {
            "stream time, s": f"{change.t_ns * 1e-9:.6f}",
            "link": change.link,
            "what": change.what,
            "before": change.before,
            "after": change.after,
            "by": change.by,
        }
        for change in result.changes
    ]
    page.heading("Changed from outside").table(rows)
    page.text(f"and {result.changes_beyond} more" if result.changes_beyond else "")


def _facts(of: ReportContent) -> dict[str, object]:
    run, late = of.rig.run, of.result.lateness
    return {
        "title": of.rig.title,
        "camera": f"{of.rig.camera.model}, {of.rig.camera.size[0]}x{of.rig.camera.size[1]} pixels",
        "scene": of.rig.scene.kind,
        "seed": run.seed,
        "pace": run.pace,
        "step": f"{run.step_us} us",
        "stream time": f"{of.result.sim_seconds:.3f} s in {of.result.wall_seconds:.3f} s",
        "frames": of.result.frames,
        "late steps": f"{late.frames_late} of {of.result.steps}, worst {late.worst_gap_us:.0f} us",
        "undersampled": undersampled_text(of.result.undersampled_share),
        "drawn by": of.result.drawn_by,
        **_machine(of),
    }


def _machine(of: ReportContent) -> dict[str, object]:
    return {
        "evstim": of.version,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
    }
