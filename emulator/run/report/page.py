"""The report of a run as files: report.html (one page, nothing to download), report.json and junit.xml."""

from __future__ import annotations

import html
import os
import platform
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import msgspec

from emulator.report.html import table, write_json, write_page
from emulator.rig.loading import Rig
from emulator.run.outcome import RunResult
from emulator.run.report.charts import interval_chart, pixel_map, rate_chart
from emulator.run.report.junit import write_junit
from emulator.run.report.observation import Observation
from emulator.run.undersampling import undersampled_advice, undersampled_text
from emulator.run.verdict import Judgement, good

__all__ = ["Reported", "write_report"]


@dataclass(frozen=True)
class Reported:
    """What a report is made of.

    Attributes
    ----------
    summary : what `evstim run --json` prints.
    version : of evstim.
    """

    rig: Rig
    result: RunResult
    seen: Observation
    judgements: tuple[Judgement, ...]
    summary: Mapping[str, Any]
    version: str


def write_report(of: Reported, folder: Path) -> list[Path]:
    """Write the three files into a folder that exists; return their paths. Raises OSError and ChartsLacking."""
    verdict = "good" if good(of.judgements) else "bad"
    body = [
        _verdict(of.judgements),
        *_advice(of.result),
        "<h2>Events</h2>",
        rate_chart(of.seen, of.result.sim_seconds),
        _ledger(of.result),
        interval_chart(of.seen),
        pixel_map(of.seen),
        "<h2>Links</h2>",
        *_links(of.result),
        *_changes(of.result),
        "<h2>Run</h2>",
        table(_run_rows(of)),
    ]
    numbers = {"verdict": verdict, "rules": [asdict(one) for one in of.judgements], **of.summary, "run": _machine(of)}
    return [
        write_page(f"{of.rig.name}: {verdict}", body, folder / "report.html"),
        write_json(msgspec.to_builtins(numbers), folder / "report.json"),
        write_junit(of.rig.name, of.judgements, of.result.wall_seconds, folder / "junit.xml"),
    ]


def _verdict(judgements: Sequence[Judgement]) -> str:
    rows = [{"rule": one.rule, "kept": "yes" if one.good else "NO", "found": one.told} for one in judgements]
    return table(rows)


def _advice(result: RunResult) -> list[str]:
    """Return a paragraph where the steps were too long for the light."""
    advice = undersampled_advice(result.undersampled_share)
    return [f"<p>{html.escape(advice)}</p>"] if advice else []


def _ledger(result: RunResult) -> str:
    """Return where every event went: of the sensor, and of each link."""
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
    return table(rows)


def _in_device(result: RunResult, name: str) -> dict[str, int]:
    camera = result.links[name].camera
    if camera is None:
        return {}
    causes = (
        *("not_running", "not_selected", "dropped_background", "dropped_refractory"),
        *("dropped_rate", "dropped_late", "dropped_fifo", "flushed"),
    )
    return {f"in the camera: {cause.replace('_', ' ')}": getattr(camera, cause) for cause in causes}


def _links(result: RunResult) -> list[str]:
    if not result.links:
        return ["<p>none</p>"]
    rows = [
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
    faults = [
        {
            "link": name,
            **{key: value if isinstance(value, float | int) else str(value) for key, value in asdict(f).items()},
        }
        for name, link in result.links.items()
        for f in link.faults
    ]
    return [table(rows), *([f"<h3>Faults</h3>{table(faults)}"] if faults else [])]


def _changes(result: RunResult) -> list[str]:
    """Return what changed the run from outside; nothing where nothing did."""
    if not result.changes:
        return []
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
    beyond = f"<p>and {result.changes_beyond} more</p>" if result.changes_beyond else ""
    return ["<h2>Changed from outside</h2>", table(rows), beyond]


def _run_rows(of: Reported) -> list[dict[str, object]]:
    run, late = of.rig.run, of.result.lateness
    told = {
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
        "pixels computed by": of.result.pixels_by or "cpu",
        **_machine(of),
    }
    return [{"what": key, "value": html.unescape(str(value))} for key, value in told.items()]


def _machine(of: Reported) -> dict[str, object]:
    return {
        "evstim": of.version,
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "python": platform.python_version(),
    }
