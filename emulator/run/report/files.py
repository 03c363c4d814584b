"""Files of a run's report: report.html (one page, nothing to download) with its sections, report.json and junit.xml.

junit.xml has the verdict in the XML that CI systems read: each rule is a test case (the JUnit schema of Apache Ant).
Until a run has ended, report.html and report.json state that it has no verdict, so that the report of an earlier run
in the same folder is not taken for that of a run that was killed.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, replace
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from emulator.light import Scene
from emulator.report.charts import printable
from emulator.report.document import Column, Document, Section, signature, swatch_legend
from emulator.report.page import write_json
from emulator.rig.loading import Rig
from emulator.run.outcome import Judgement, RunResult, judge, undersampled_advice
from emulator.run.report.content import (
    SCHEMA,
    Circumstances,
    ReportContent,
    environment,
    fates,
    happenings,
    numbers,
    pixel_counts,
    rig_file,
    verdict_words,
)
from emulator.run.report.figures import fate_bars, interval_chart, latency_chart, letters, pixel_maps, strip, timeline
from emulator.run.report.modelled import modelled
from emulator.run.report.observation import Observation

_MOST_FILE_CHARACTERS = 30_000
_LEAST_SHARE = 1e-9
_OWN_RULES = ("max_drop", "min_rate_hz", "max_rate_hz", "max_latency_us", "max_undersampled")


def begin_files(rig: Rig, folder: Path, began: datetime) -> None:
    """Write the page and the JSON of a run that has not ended, and remove an earlier junit.xml; raises OSError."""
    text = began.isoformat(timespec="seconds")
    words = f"The run that began at {text} has not ended. If it no longer runs, it was killed: it has no verdict."
    Document(f"{rig.name}: report of a run", rig.title, "unfinished", words).write(folder / "report.html")
    begun = {"schema": SCHEMA, "verdict": "unfinished", "rig": rig.name, "rig_file": rig_file(rig), "began": text}
    write_json(begun, folder / "report.json")
    (folder / "junit.xml").unlink(missing_ok=True)


def write_report(of: ReportContent, folder: Path) -> list[Path]:
    """Write the three files into a folder that exists; return their paths, the page first. Raises OSError."""
    values = write_json(numbers(of), folder / "report.json")
    digest = hashlib.sha256(values.read_bytes()).hexdigest()
    return [
        page_of(of, digest).write(folder / "report.html"),
        values,
        write_junit(of.rig.name, of.rules, of.result.wall_seconds, folder / "junit.xml"),
    ]


def write_junit(rig: str, judgements: tuple[Judgement, ...], seconds: float, path: Path) -> Path:
    """Write one test suite named after the rig; return the path. XML has no control characters: they become spaces."""
    failed = sum(not judgement.good for judgement in judgements)
    counts = {"tests": str(len(judgements)), "failures": str(failed), "errors": "0", "time": f"{seconds:.3f}"}
    suites = ElementTree.Element("testsuites", counts)
    suite = ElementTree.SubElement(suites, "testsuite", {"name": f"evstim {printable(rig)}", **counts})
    for judgement in judgements:
        name, finding = printable(judgement.rule), printable(judgement.finding)
        about = {"classname": f"evstim.{printable(rig)}", "name": name, "time": "0"}
        case = ElementTree.SubElement(suite, "testcase", about)
        if judgement.good:
            ElementTree.SubElement(case, "system-out").text = finding
        else:
            ElementTree.SubElement(case, "failure", {"message": finding}).text = finding
    ElementTree.ElementTree(suites).write(path, encoding="utf-8", xml_declaration=True)
    return path


class RunReporter:
    """Observation of a run, and its report when the run has ended.

    The constructor makes the folder, which may exist already, with files that state no verdict; it may raise OSError.
    """

    def __init__(self, rig: Rig, folder: Path) -> None:
        self.folder = folder
        self._rig = rig
        self.seen = Observation(rig.camera.size)
        began = datetime.now(UTC)
        self._circumstances = Circumstances(began)
        folder.mkdir(parents=True, exist_ok=True)
        begin_files(rig, folder, began)

    def plan(self, scene: Scene, *, is_driven: bool) -> None:
        """Record what the run models, before it begins; raises SceneError."""
        self._circumstances = replace(self._circumstances, modelled=modelled(self._rig, scene, is_driven=is_driven))

    def write(self, result: RunResult, summary: Mapping[str, Any], truth_trouble: str = "") -> Path:
        """Write the report and return its page; a `truth_trouble` makes the run bad. Raises OSError."""
        judgements = judge(self._rig.verdict, result)
        circumstances = replace(self._circumstances, ended=datetime.now(UTC), truth_trouble=truth_trouble)
        content = ReportContent(self._rig, result, self.seen, judgements, summary, version("evstim"), circumstances)
        return write_report(content, self.folder)[0]


def page_of(of: ReportContent, json_digest: str) -> Document:
    """Return the page of a report; `json_digest` is the SHA-256 of its report.json."""
    test = of.circumstances.test
    subtitle = f"run by the test {test}" if test else of.rig.title
    page = Document(f"{of.rig.name}: report of a run", subtitle, of.verdict, verdict_words(of.rules))
    for section in (_rules, _run, _timeline, _ledger, _latency, _pictures, _modelled, _machine):
        page.add(section(of))
    page.add(_signature(of, json_digest))
    return page if of.rig.source is None else page.add(_file(of.rig.source.path, of.rig.source.text))


def _rules(of: ReportContent) -> Section:
    rows = [
        {**asdict(rule), "bound": None if rule.bound is None else f"{rule.side} {rule.bound:.6g}"} for rule in of.rules
    ]
    columns = [
        Column("rule", "rule"), Column("good", "verdict", "verdict"), Column("figure", "figure", "number"),
        Column("bound", "bound", "number"), Column("unit", "unit"), Column("finding", "finding"),
    ]  # fmt: skip
    section = Section("Rules").table("All rules of this run, with figure and bound", columns, rows)
    unset = [f"verdict.{name}" for name in _OWN_RULES if not any(name in rule.rule for rule in of.rules)]
    if of.circumstances.test:
        section.text("The verdict is on the rig: the test judges its program, and lateness where it matters.", "note")
    elif unset:
        section.text(f"Not judged, because the rig sets no limit: {', '.join(unset)}.", "note")
    return section.text(undersampled_advice(of.result))


def _run(of: ReportContent) -> Section:
    run, source = of.rig.run, of.rig.source
    result, late = of.result, of.result.lateness
    began, ended = of.circumstances.began, of.circumstances.ended
    options = {} if source is None else source.options
    facts = {
        "rig file": "made by a program, no file" if source is None else source.path,
        "SHA-256 of the rig file": None if source is None else source.sha256,
        "replaced by options": ", ".join(f"{key} = {value}" for key, value in options.items()) or "none",
        "began": None if began is None else f"{began:%Y-%m-%d %H:%M:%S} UTC",
        "ended": None if ended is None else f"{ended:%Y-%m-%d %H:%M:%S} UTC",
        "camera": f"{of.rig.camera.model}, {of.rig.camera.size[0]} x {of.rig.camera.size[1]} pixels",
        "scene": of.rig.scene.kind,
        "drawn by": result.drawn_by,
        "seed": str(run.seed),
        "pace": run.pace,
        "step": f"{run.step_us} us",
        "quality": "none" if run.quality < 0 else str(run.quality),
        "stream time": f"{result.sim_seconds:.3f} s in {result.wall_seconds:.3f} s",
        "light frames": result.frames,
        "late steps": f"{late.frames_late} of {result.steps}, worst {late.worst_gap_us:.0f} us",
        "undersampled": "not measured"
        if (share := result.undersampled_share) is None
        else f"{share:.3g} of the solved pixel-steps",
    }
    return Section("Run").facts("The run and its rig", facts)


def _timeline(of: ReportContent) -> Section:
    marked = happenings(of.result)
    section = Section("Timeline")
    chart = timeline(of, marked)
    if not chart:
        return section.text("No event was raised, and nothing happened.")
    bin_s = of.seen.rates.bin_us * 1e-6
    section.chart(chart).element(swatch_legend([("on", "ON events"), ("off", "OFF events (dashed)")]))
    section.text(
        f"Rates in bins of {bin_s:g} s. F, T and C are the faults, triggers and commands of the table.", "note"
    )
    columns = [
        Column("label", "mark"), Column("t_s", "stream time, s", "number"), Column("until_s", "until, s", "number"),
        Column("link", "link"), Column("what", "what"), Column("by", "by"),
    ]  # fmt: skip
    rows = [
        {
            **asdict(happening),
            "t_s": f"{happening.t_s:.6f}",
            "until_s": None if happening.until_s is None else f"{happening.until_s:.6f}",
        }
        for happening in marked
    ]
    section.table("Faults, triggers and commands", columns, rows)
    beyond = of.result.changes_beyond
    section.text(f"and {beyond} further changes, counted only" if beyond else "", "note")
    effects = [
        {"link": name, **asdict(record), "log_trouble": record.log_trouble or None}
        for name, link in of.result.links.items()
        for record in link.faults
    ]
    return section.table("Effects of the faults", _FAULT_COLUMNS, effects)


_FAULT_COLUMNS = [
    Column("link", "link"), Column("number", "number on the link", "number"), Column("kind", "kind"),
    Column("hits", "hits", "number"), Column("touched", "units affected", "number"),
    Column("events_lost", "events lost", "number"), Column("edges_lost", "edges lost", "number"),
    Column("log_trouble", "fault log"),
]  # fmt: skip


def _ledger(of: ReportContent) -> Section:
    """Return the fate of every event, as bars and as a table."""
    all_fates = fates(of.result)
    section = Section("Ledger of events", "together")
    balanced = of.result.ledger.balanced
    section.text("Every event has exactly one fate." if balanced else "")
    section.text("" if balanced else f"NOT BALANCED: {of.result.ledger.imbalance} events without a fate, or with two.")
    for caption, bar in fate_bars(all_fates):
        section.chart(bar, caption)
    totals = {fate.link: sum(other.events for other in all_fates if other.link == fate.link) for fate in all_fates}
    rows = [
        {
            "key": key,
            "where": f"link {fate.link}" if fate.link else "sensor",
            "fate": fate.fate,
            "events": fate.events,
            "share": f"{fate.events / totals[fate.link]:.2%}" if totals[fate.link] else None,
        }
        for key, fate in zip(letters(all_fates), all_fates, strict=True)
    ]
    columns = [
        Column("key", "key"), Column("where", "where"), Column("fate", "fate"), Column("events", "events", "number"),
        Column("share", "share", "number"),
    ]  # fmt: skip
    return section.table("Fates of the events; the keys stand in the bars", columns, rows)


def _latency(of: ReportContent) -> Section:
    section = Section("Links and latency")
    if not of.result.links:
        return section.text("This rig has no link.")
    chart = latency_chart(of)
    section.text("" if chart else "No latency was measured: without pacing, or without a host, none arises.", "note")
    section.chart(chart, "circle: median; square: 99 %; diamond: 99.9 %; triangle: largest. A dashed line is a bound.")
    rows = [
        {
            "link": name,
            "state": link.state,
            "digest": f"{link.digest:08x}",
            **asdict(link.latency),
            "bound": of.rig.verdict.max_latency_us or None,
            "use": None if link.use is None else f"{link.use.share:.1%}",
            "offset": None if link.clock is None else link.clock.offset_us,
            "ppm": None if link.clock is None else link.clock.ppm,
            "error": link.error or "; ".join(link.file_troubles) or None,
        }
        for name, link in of.result.links.items()
    ]
    return section.table("Links: latency from an event's time to the socket", _LINK_COLUMNS, rows)


_LINK_COLUMNS = [
    Column("link", "link"), Column("state", "state"), Column("digest", "digest", "code"),
    Column("p50", "p50, us", "number"), Column("p99", "p99, us", "number"), Column("p999", "p99.9, us", "number"),
    Column("max", "max, us", "number"), Column("bound", "bound of p99, us", "number"),
    Column("use", "line used", "number"), Column("offset", "clock offset, us", "number"),
    Column("ppm", "clock drift, ppm", "number"), Column("error", "trouble"),
]  # fmt: skip


def _pictures(of: ReportContent) -> Section:
    section = Section("Pixels and pictures")
    pictures = strip(of.seen)
    section.heading("Pictures of the run")
    if pictures:
        section.text("Light, with the events of the last 40 ms: ON bright orange, OFF light blue.", "note")
    else:
        section.text("No picture was taken: the run was too short, or the report had no light.", "note")
    section.element(pictures)
    counts = pixel_counts(of.seen)
    silent = f"{counts['silent']} of {counts['count']} pixels have no event."
    section.heading("Events of each pixel").element(pixel_maps(of.seen)).text(silent)
    rows = [{**pixel, "share": f"{pixel['share']:.2%}"} for pixel in counts["busiest"]]
    columns = [Column("x", "x, px"), Column("y", "y, px", "number"), Column("events", "events", "number")]
    section.table("The busiest pixels", [*columns, Column("share", "of all events", "number")], rows)
    return section.chart(interval_chart(of.seen), "Time between two events of a pixel, of one pixel in eight")


def _modelled(of: ReportContent) -> Section:
    section, plan = Section("Modelled and left out"), of.circumstances.modelled
    if plan is None:
        return section.text("The program that made this report gave no plan of the run.")
    section.text(f"Steps: {plan.steps}." if plan.steps else "")
    if plan.tolerance_us is not None:
        section.text(f"Tolerance: {plan.tolerance_us:g} us of event times, {plan.tolerated_wrong_share} of the events.")
    section.table("Parts", [Column("part", "part"), Column("how", "how")], [asdict(part) for part in plan.parts])
    if plan.effects and not plan.probed:
        section.text("Errors were not measured: the light frames belong to another program.")
    columns = [
        Column("effect", "effect"), Column("state", "state"),
        Column("time_error_us", "time error without it, us", "number"),
        Column("wrong_share", "wrong events without it", "number"), Column("why", "why"),
    ]  # fmt: skip
    on = [effect for effect in plan.effects if effect.state != "off"]
    rows = [{**asdict(effect), "wrong_share": _share(effect.wrong_share)} for effect in on]
    section.table("Effects of the plan", columns, rows)
    off = [effect.effect for effect in plan.effects if effect.state == "off"]
    section.text(f"Switched off, or without effect, in this rig and camera: {', '.join(off)}." if off else "")
    return section.listed([f"Note: {note}" for note in plan.notes])


def _share(value: float | None) -> float | str | None:
    return f"below {_LEAST_SHARE:g}" if value is not None and 0 < value < _LEAST_SHARE else value


def _machine(of: ReportContent) -> Section:
    machine = environment()
    packages: Mapping[str, str] = machine["packages"]
    facts = {
        "evstim": of.version,
        "machine": machine["host"],
        "system": machine["system"],
        "processor": f"{machine['processor']}, {machine['cores']} cores",
        "memory": None if machine["memory_gib"] is None else f"{machine['memory_gib']} GiB",
        "python": machine["python"],
        **{name: text for name, text in packages.items() if name != "evstim"},
    }
    return Section("Machine and versions").facts("Where the run was computed", facts)


def _signature(of: ReportContent, json_digest: str) -> Section:
    source = of.rig.source
    digest = "without a file" if source is None else f"SHA-256 {source.sha256}"
    lines: Sequence[str] = (
        f"Rig {of.rig.name}, {digest}. Verdict of the program: {of.verdict.upper()}. {verdict_words(of.rules)}",
        f"Numbers of this page: report.json, SHA-256 {json_digest}.",
    )
    return signature(lines)


def _file(path: str, text: str) -> Section:
    shown = text[:_MOST_FILE_CHARACTERS]
    section = Section("Rig file", "file whole").text(path, "note").code(shown)
    return section.text(f"and {len(text) - len(shown)} more characters" if len(text) > len(shown) else "", "note")
