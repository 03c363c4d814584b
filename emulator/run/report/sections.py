"""Sections of the page of a run's report, from its content."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any

from emulator.report.document import Column, Document, Section, signature, swatch_legend
from emulator.run.outcome import undersampled_advice, undersampled_text
from emulator.run.report.content import (
    ReportContent,
    environment,
    fates,
    happenings,
    pixel_counts,
    verdict_words,
)
from emulator.run.report.figures import (
    fate_bars,
    interval_chart,
    latency_chart,
    letters,
    pixel_maps,
    strip,
    timeline,
)

_MOST_FILE_CHARACTERS = 30_000
_LEAST_SHARE = 1e-9
_OWN_RULES = ("max_drop", "min_rate_hz", "max_rate_hz", "max_latency_us", "max_undersampled")


def page_of(of: ReportContent, json_digest: str) -> Document:
    """Return the page of a report; `json_digest` is the SHA-256 of its report.json."""
    test = of.circumstances.test
    subtitle = f"run by the test {test}" if test else of.rig.title
    page = Document(f"{of.rig.name}: report of a run", subtitle, (of.verdict, verdict_words(of.rules)))
    for section in _sections(of, json_digest):
        page.add(section)
    return page


def unfinished_page(rig: str, title: str, began: str) -> Document:
    """Return the page in the place of a report until its run has ended."""
    words = f"The run that began at {began} has not ended. If it no longer runs, it was killed: it has no verdict."
    return Document(f"{rig}: report of a run", title, ("unfinished", words))


def _sections(of: ReportContent, json_digest: str) -> Iterator[Section]:
    yield _rules(of)
    yield _run(of)
    yield _timeline(of)
    yield _ledger(of)
    yield _latency(of)
    yield _pictures(of)
    yield _modelled(of)
    yield _machine(of)
    yield _signature(of, json_digest)
    if of.rig.source is not None:
        yield _file(of.rig.source.path, of.rig.source.text)


def _rules(of: ReportContent) -> Section:
    rows = [{**asdict(one), "bound": None if one.bound is None else f"{one.side} {one.bound:.6g}"} for one in of.rules]
    columns = [
        Column("rule", "rule"),
        Column("good", "verdict", "verdict"),
        Column("figure", "figure", "number"),
        Column("bound", "bound", "number"),
        Column("unit", "unit"),
        Column("finding", "finding"),
    ]
    made = Section("Rules").table("All rules of this run, with figure and bound", columns, rows)
    unset = [f"verdict.{name}" for name in _OWN_RULES if not any(name in one.rule for one in of.rules)]
    if of.circumstances.test:
        made.text("The verdict is on the rig: the test judges its program, and lateness where it matters.", "note")
    elif unset:
        made.text(f"Not judged, because the rig sets no limit: {', '.join(unset)}.", "note")
    return made.text(undersampled_advice(of.result))


def _run(of: ReportContent) -> Section:
    run, result, late, source = of.rig.run, of.result, of.result.lateness, of.rig.source
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
        "stream time": f"{result.sim_seconds:.3f} s in {result.wall_seconds:.3f} s",
        "light frames": result.frames,
        "late steps": f"{late.frames_late} of {result.steps}, worst {late.worst_gap_us:.0f} us",
        "undersampled": undersampled_text(result.undersampled_share),
    }
    return Section("Run").facts("The run and its rig", facts)


def _timeline(of: ReportContent) -> Section:
    marked = happenings(of.result)
    made = Section("Timeline")
    chart = timeline(of, marked)
    if not chart:
        return made.text("No event was raised, and nothing happened.")
    bin_s = of.seen.rates.bin_us * 1e-6
    made.chart(chart).element(swatch_legend([("on", "ON events"), ("off", "OFF events (dashed)")]))
    made.text(f"Rates in bins of {bin_s:g} s. F, T and C are the faults, triggers and commands of the table.", "note")
    columns = [
        Column("label", "mark"),
        Column("t_s", "stream time, s", "number"),
        Column("until_s", "until, s", "number"),
        Column("link", "link"),
        Column("what", "what"),
        Column("by", "by"),
    ]
    rows = [{**asdict(one), "t_s": f"{one.t_s:.6f}", "until_s": _seconds(one.until_s)} for one in marked]
    made.table("Faults, triggers and commands", columns, rows)
    beyond = of.result.changes_beyond
    made.text(f"and {beyond} further changes, counted only" if beyond else "", "note")
    return made.table("Effects of the faults", _FAULT_COLUMNS, list(_fault_rows(of)))


def _seconds(value: float | None) -> str | None:
    return None if value is None else f"{value:.6f}"


_FAULT_COLUMNS = [
    Column("link", "link"),
    Column("number", "number on the link", "number"),
    Column("kind", "kind"),
    Column("hits", "hits", "number"),
    Column("touched", "units affected", "number"),
    Column("events_lost", "events lost", "number"),
    Column("edges_lost", "edges lost", "number"),
    Column("log_trouble", "fault log"),
]


def _fault_rows(of: ReportContent) -> Iterator[Mapping[str, Any]]:
    for name, link in of.result.links.items():
        for record in link.faults:
            yield {"link": name, **asdict(record), "log_trouble": record.log_trouble or None}


def _ledger(of: ReportContent) -> Section:
    """Return the fate of every event, as bars and as a table."""
    found = fates(of.result)
    made = Section("Ledger of events", "together")
    balanced = of.result.ledger.balanced
    made.text("Every event has exactly one fate." if balanced else "")
    made.text("" if balanced else f"NOT BALANCED: {of.result.ledger.imbalance} events without a fate, or with two.")
    for caption, bar in fate_bars(found):
        made.chart(bar, caption)
    totals = {one.link: sum(other.events for other in found if other.link == one.link) for one in found}
    rows = [
        {
            "key": key,
            "where": f"link {one.link}" if one.link else "sensor",
            "fate": one.fate,
            "events": one.events,
            "share": f"{one.events / totals[one.link]:.2%}" if totals[one.link] else None,
        }
        for key, one in zip(letters(found), found, strict=True)
    ]
    columns = [
        Column("key", "key"),
        Column("where", "where"),
        Column("fate", "fate"),
        Column("events", "events", "number"),
        Column("share", "share", "number"),
    ]
    return made.table("Fates of the events; the keys stand in the bars", columns, rows)


def _latency(of: ReportContent) -> Section:
    made = Section("Links and latency")
    if not of.result.links:
        return made.text("This rig has no link.")
    chart = latency_chart(of)
    made.text("" if chart else "No latency was measured: without pacing, or without a host, none arises.", "note")
    made.chart(chart, "circle: median; square: 99 %; diamond: 99.9 %; triangle: largest. A dashed line is a bound.")
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
    return made.table("Links: latency from an event's time to the socket", _LINK_COLUMNS, rows)


_LINK_COLUMNS = [
    Column("link", "link"),
    Column("state", "state"),
    Column("digest", "digest", "code"),
    Column("p50", "p50, us", "number"),
    Column("p99", "p99, us", "number"),
    Column("p999", "p99.9, us", "number"),
    Column("max", "max, us", "number"),
    Column("bound", "bound of p99, us", "number"),
    Column("use", "line used", "number"),
    Column("offset", "clock offset, us", "number"),
    Column("ppm", "clock drift, ppm", "number"),
    Column("error", "trouble"),
]


def _pictures(of: ReportContent) -> Section:
    made = Section("Pixels and pictures")
    pictures = strip(of.seen)
    made.heading("Pictures of the run")
    if pictures:
        made.text("Light, with the events of the last 40 ms: ON bright orange, OFF light blue.", "note")
    else:
        made.text("No picture was taken: the run was too short, or the report had no light.", "note")
    made.element(pictures)
    counts = pixel_counts(of.seen)
    silent = f"{counts['silent']} of {counts['count']} pixels have no event."
    made.heading("Events of each pixel").element(pixel_maps(of.seen)).text(silent)
    rows = [{**one, "share": f"{one['share']:.2%}"} for one in counts["busiest"]]
    columns = [Column("x", "x, px"), Column("y", "y, px", "number"), Column("events", "events", "number")]
    made.table("The busiest pixels", [*columns, Column("share", "of all events", "number")], rows)
    return made.chart(interval_chart(of.seen), "Time between two events of a pixel, of one pixel in eight")


def _modelled(of: ReportContent) -> Section:
    made, found = Section("Modelled and left out"), of.circumstances.modelled
    if found is None:
        return made.text("The program that made this report gave no plan of the run.")
    made.text(f"Steps: {found.steps}." if found.steps else "")
    if found.tolerance_us is not None:
        made.text(f"Tolerance: {found.tolerance_us:g} us of event times, {found.tolerated_wrong_share} of the events.")
    made.table("Parts", [Column("part", "part"), Column("how", "how")], [asdict(part) for part in found.parts])
    if found.effects and not found.probed:
        made.text("Errors were not measured: the light frames belong to another program.")
    columns = [
        Column("effect", "effect"),
        Column("state", "state"),
        Column("time_error_us", "time error without it, us", "number"),
        Column("wrong_share", "wrong events without it", "number"),
        Column("why", "why"),
    ]
    on = [
        {**asdict(effect), "wrong_share": _share(effect.wrong_share)}
        for effect in found.effects
        if effect.state != "off"
    ]
    made.table("Effects of the plan", columns, on)
    off = [effect.effect for effect in found.effects if effect.state == "off"]
    made.text(f"Switched off, or without effect, in this rig and camera: {', '.join(off)}." if off else "")
    return made.listed([f"Note: {note}" for note in found.notes])


def _share(value: float | None) -> float | str | None:
    return f"below {_LEAST_SHARE:g}" if value is not None and 0 < value < _LEAST_SHARE else value


def _machine(of: ReportContent) -> Section:
    found = environment()
    packages: Mapping[str, str] = found["packages"]
    facts = {
        "evstim": of.version,
        "machine": found["host"],
        "system": found["system"],
        "processor": f"{found['processor']}, {found['cores']} cores",
        "memory": None if found["memory_gib"] is None else f"{found['memory_gib']} GiB",
        "python": found["python"],
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
    made = Section("Rig file", "file whole").text(path, "note").code(shown)
    return made.text(f"and {len(text) - len(shown)} more characters" if len(text) > len(shown) else "", "note")
