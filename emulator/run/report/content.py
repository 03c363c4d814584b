"""Content of a report: the run with its rig, its rules and its circumstances, and the numbers of report.json.

report.json has the object of `evstim run --json` and, beside it, the file of the rig, the machine, what was modelled,
the timeline and the pixels. `report.schema.json` in this folder is its schema. The key `schema` names its version,
which changes when a key is removed or gets another meaning; a new key does not change it.
"""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any, Literal

import msgspec
import numpy as np

from emulator.rig.loading import Rig
from emulator.run.outcome import Judgement, RunResult, good
from emulator.run.report.modelled import Modelled
from emulator.run.report.observation import Observation

SCHEMA = "evstim-report-1"
"""Name and version of the schema of report.json."""

_PACKAGES = ("evstim", "numpy", "numba", "llvmlite", "scipy", "msgspec", "moderngl", "trimesh", "pyusb", "python-can")
_MOST_HAPPENINGS = 1000
_BUSIEST = 5


@dataclass(frozen=True)
class Circumstances:
    """Circumstances of a run that its result does not have.

    Attributes
    ----------
    began, ended : date and time, UTC; None where they are not known.
    truth_trouble : reason why the truth file is incomplete, which makes the run bad; "" where there is none.
    test : name of the test that ran the rig, and that judges lateness and rates itself; "" where there is none.
    """

    began: datetime | None = None
    ended: datetime | None = None
    modelled: Modelled | None = None
    truth_trouble: str = ""
    test: str = ""


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
    circumstances: Circumstances = field(default_factory=Circumstances)

    @property
    def rules(self) -> tuple[Judgement, ...]:
        """All rules that were judged, that of the truth file included."""
        trouble = self.circumstances.truth_trouble
        return (*self.judgements, Judgement("truth file", good=False, finding=trouble)) if trouble else self.judgements

    @property
    def verdict(self) -> Literal["good", "bad"]:
        """The verdict by all rules."""
        return "good" if good(self.rules) else "bad"


def verdict_words(rules: Sequence[Judgement]) -> str:
    """Return the verdict in a sentence: how many rules were kept, and which were broken."""
    broken = [rule.rule for rule in rules if not rule.good]
    if not broken:
        return f"All {len(rules)} rules were kept."
    return f"{len(broken)} of {len(rules)} rules broken: {', '.join(broken)}."


@dataclass(frozen=True)
class Fate:
    """Events with one fate, at the sensor (`link` is empty) or at a link."""

    link: str
    fate: str
    events: int
    kind: Literal["fine", "lost", "held", "cut", "gone"]


_CAUSES: Mapping[str, tuple[str, Literal["held", "cut", "gone"]]] = {
    "not_running": ("no host was streaming", "held"),
    "not_selected": ("not selected by the host", "held"),
    "dropped_background": ("camera: background filter", "cut"),
    "dropped_refractory": ("camera: refractory filter", "cut"),
    "dropped_rate": ("camera: over the rate limit", "gone"),
    "dropped_late": ("camera: too late", "gone"),
    "dropped_fifo": ("camera: FIFO full", "gone"),
    "flushed": ("camera: flushed at a stop", "gone"),
}


def fates(result: RunResult) -> list[Fate]:
    """Return the fates of all events, those of the sensor first; fates of a link without an event are left out."""
    ledger = result.ledger
    listed = [
        Fate("", "read out", ledger.read_out, "fine"),
        Fate("", "lost in the pixel", ledger.lost_in_pixel, "gone"),
        Fate("", "lost at the read-out", ledger.lost_at_readout, "lost"),
    ]
    for link in (*ledger.links, *(ledger.second.links if ledger.second else ())):
        listed.append(Fate(link.name, "delivered", link.delivered, "fine"))
        dropped = [Fate(link.name, "dropped by the link", link.dropped, "lost")]
        report = result.links.get(link.name)
        if report is not None and (camera := report.camera) is not None:
            dropped += [Fate(link.name, text, getattr(camera, cause), kind) for cause, (text, kind) in _CAUSES.items()]
        named = sum(fate.events for fate in dropped[1:])
        dropped.append(Fate(link.name, "camera: other causes", max(link.dropped_in_device - named, 0), "gone"))
        listed += [fate for fate in dropped if fate.events]
    return listed


@dataclass(frozen=True)
class Happening:
    """A fault, a trigger or a command in the timeline; `until_s` is the end of a fault, None where it has none."""

    label: str
    lane: Literal["fault", "trigger", "command"]
    t_s: float
    until_s: float | None
    link: str
    what: str
    by: str


def happenings(result: RunResult) -> list[Happening]:
    """Return at most 1000 faults, and 1000 triggers and commands, each by time, labelled F1, T1, C1 and so on."""
    return [*_faults(result), *_changes(result)]


def _faults(result: RunResult) -> list[Happening]:
    records = [(record, name) for name, link in result.links.items() for record in link.faults]
    records.sort(key=lambda row: row[0].began_us)
    faults = []
    for k, (record, name) in enumerate(records[:_MOST_HAPPENINGS]):
        until_s = result.sim_seconds if record.ended_us is None else record.ended_us / 1e6
        faults.append(Happening(f"F{k + 1}", "fault", record.began_us / 1e6, until_s, name, record.kind, "fault"))
    return faults


def _changes(result: RunResult) -> Iterator[Happening]:
    number = {"trigger": 0, "command": 0}
    listed = [change for change in result.changes if not change.what.startswith("fault ")]
    for change in listed[:_MOST_HAPPENINGS]:
        lane: Literal["trigger", "command"] = "trigger" if change.what.startswith("trigger") else "command"
        number[lane] += 1
        values = "" if change.after is None else f" {_figure(change.before)} to {_figure(change.after)}"
        label, t_s = f"{lane[0].upper()}{number[lane]}", change.t_ns / 1e9
        yield Happening(label, lane, t_s, None, change.link, change.what + values, change.by)


def _figure(value: float | None) -> str:
    return "-" if value is None else f"{value:.4g}"


def rig_file(rig: Rig) -> dict[str, Any] | None:
    """Return path, SHA-256 digest and replaced options of the rig's file; None for a rig without a file."""
    if (source := rig.source) is None:
        return None
    return {"path": source.path, "sha256": source.sha256, "options": dict(source.options)}


def environment() -> dict[str, Any]:
    """Return this machine, and the versions of evstim and of the packages that compute."""
    return {
        "host": platform.node(),
        "system": f"{platform.system()} {platform.release()} {platform.machine()}",
        "processor": _processor(),
        "cores": os.cpu_count(),
        "memory_gib": _memory_gib(),
        "python": platform.python_version(),
        "packages": {name: package_version for name in _PACKAGES if (package_version := _version(name))},
    }


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def _processor() -> str:
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8", errors="replace").splitlines():
            if line.startswith("model name"):
                return line.partition(":")[2].strip()
    return platform.processor()


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30, 1)
    except (OSError, ValueError):
        return None


def numbers(of: ReportContent) -> dict[str, Any]:
    """Return the object of report.json, of plain types."""
    circumstances, machine = of.circumstances, environment()
    values = {
        "schema": SCHEMA, "verdict": of.verdict, "words": verdict_words(of.rules), **of.summary,
        "rules": [rule.as_json() for rule in of.rules], "title": of.rig.title, "test": circumstances.test,
        "rig_file": rig_file(of.rig), "began": _date(circumstances.began), "ended": _date(circumstances.ended),
        "settings": {key: getattr(of.rig.run, key) for key in ("seed", "pace", "step_us", "quality")},
        "modelled": circumstances.modelled,
        "timeline": _timeline(of), "pixels": pixel_counts(of.seen), "environment": machine,
        "run": {"evstim": of.version, "machine": machine["system"], "python": machine["python"]},
    }  # fmt: skip
    plain: dict[str, Any] = msgspec.to_builtins(values, str_keys=True)
    return plain


def _date(moment: datetime | None) -> str | None:
    return None if moment is None else moment.isoformat(timespec="seconds")


def _timeline(of: ReportContent) -> dict[str, Any]:
    rates, counts = of.seen.rates, of.seen.counts
    on = rates.column(Observation.ON)
    return {
        "bin_us": rates.bin_us,
        "on": on.tolist(),
        "off": (rates.column(Observation.EVENTS) - on).tolist(),
        "status_bin_us": counts.bin_us,
        "late_steps": counts.column(Observation.LATE).tolist(),
        "edges": counts.column(Observation.EDGES).tolist(),
        "happenings": happenings(of.result),
    }


def pixel_counts(seen: Observation) -> dict[str, Any]:
    """Return the number of pixels, of those without an event, and the five busiest ones."""
    every = seen.on + seen.off
    width, total = every.shape[1], int(every.sum())
    busiest = np.argsort(every, axis=None, kind="stable")[::-1][:_BUSIEST]
    places = [(int(k % width), int(k // width), int(every.flat[k])) for k in busiest if every.flat[k]]
    return {
        "count": every.size,
        "silent": int((every == 0).sum()),
        "busiest": [{"x": x, "y": y, "events": count, "share": count / total} for x, y, count in places],
    }


def report_schema() -> dict[str, Any]:
    """Return the JSON Schema of report.json."""
    schema: dict[str, Any] = json.loads(Path(__file__).with_name("report.schema.json").read_text(encoding="utf-8"))
    return schema
