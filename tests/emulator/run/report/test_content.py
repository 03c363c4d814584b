"""Content of a report: report.json by its schema, what happened when, hostile and incomplete runs, bounded size."""

import dataclasses
import hashlib
import json
from datetime import UTC, datetime
from xml.etree import ElementTree

import jsonschema
import numpy as np
import pytest

from emulator.rig.loading import load_rig, with_options
from emulator.run.changes import Change
from emulator.run.outcome import Ledger, LinkLedger, RunResult, judge
from emulator.run.pacing import Lateness
from emulator.run.report.content import SCHEMA, Circumstances, ReportContent, fates, happenings, report_schema
from emulator.run.report.files import begin_files, write_report
from emulator.run.report.modelled import Effect, Modelled, Part
from emulator.run.report.observation import Observation
from firmware_protocol.device.fates import Fates
from firmware_protocol.events import EVENT
from tests.made_events import scattered
from transports.faults.script import FaultRecord
from transports.link.deliveries import LatencySummary
from transports.link.report import LinkReport

NASTY = '<script>alert("&")</script>\x00'
EMPTY = RunResult(0.0, 0.0, 0, 0, Ledger(0, 0, 0, 0), Lateness())
NOON = datetime(2026, 1, 2, 12, tzinfo=UTC)


def ledger(**links):
    return Ledger(110, 4, 6, 100, tuple(LinkLedger(name, *fates) for name, fates in links.items()))


def full(name="usb"):
    camera = Fates(offered=100, not_running=20, dropped_fifo=5, delivered=75)
    fault = FaultRecord(1, "usb_silence", 200_000, 400_000, events_lost=3)
    report = LinkReport(
        "open", delivered=70, dropped=5, camera=camera, latency=LatencySummary(10.0, 90.0, 100.0, 95.0), faults=(fault,)
    )
    return dataclasses.replace(
        EMPTY,
        sim_seconds=1.0,
        wall_seconds=1.0,
        steps=10,
        ledger=ledger(**{name: (70, 5, 25)}),
        links={name: report},
        changes=(
            Change(500_000_000, "evstim", "trigger pulse", name),
            Change(600_000_000, "register", "threshold_on", name, 0.2, 0.3),
            Change(200_000_000, "evstim", "fault usb_silence", name),
        ),
    )


def seen_of(count=1000, size=(20, 10)):
    seen = Observation(size)
    times = np.sort(np.random.default_rng(1).integers(0, 1_000_000, count))
    seen.take(scattered(times, size), np.ones(size[::-1], np.float32), 1_000_000)
    return seen


@pytest.fixture
def written(tmp_path):
    def write(result=EMPTY, seen=None, rig=None, there=None):
        rig = rig or load_rig("checkerboard")
        content = ReportContent(
            rig, result, seen or Observation((20, 10)), judge(rig.verdict, result), {"rig": rig.name}, "1.0",
            there or Circumstances(NOON, NOON),
        )  # fmt: skip
        page, numbers, junit = write_report(content, tmp_path)
        ElementTree.parse(junit)
        return page.read_text(encoding="utf-8"), checked(json.loads(numbers.read_text()))

    return write


def checked(numbers):
    jsonschema.validate(numbers, report_schema(), jsonschema.Draft202012Validator)
    return numbers


def test_the_schema_is_a_schema_and_refuses_another_version(written):
    jsonschema.Draft202012Validator.check_schema(report_schema())
    _, numbers = written(full(), seen_of())
    assert numbers["schema"] == SCHEMA
    for wrong in ({"schema": "evstim-report-2"}, {"verdict": "fine"}, {"pixels": {}}, {"rules": []}):
        with pytest.raises(jsonschema.ValidationError):
            checked({**numbers, **wrong})


def test_the_page_names_the_file_its_digest_and_the_options(written):
    rig = with_options(load_rig("checkerboard"), seconds=3.0, seed=7)
    page, numbers = written(full(), seen_of(), rig)
    with open(rig.source.path, "rb") as file:
        digest = hashlib.sha256(file.read()).hexdigest()
    assert numbers["rig_file"] == {"path": rig.source.path, "sha256": digest, "options": {"seconds": 3.0, "seed": 7}}
    assert page.count(digest) == 2
    assert "seconds = 3.0, seed = 7" in page
    assert "kind = &quot;checkerboard&quot;" in page


def test_a_signature_holds_for_the_numbers_beside_the_page(written, tmp_path):
    page, _ = written(full(), seen_of())
    assert hashlib.sha256((tmp_path / "report.json").read_bytes()).hexdigest() in page


def test_every_rule_has_its_figure_and_bound(written):
    rig = load_rig("checkerboard")
    rig = dataclasses.replace(rig, verdict=dataclasses.replace(rig.verdict, max_latency_us=50.0, min_rate_hz=10.0))
    page, numbers = written(full(), seen_of(), rig)
    rules = {one["rule"]: (one["figure"], one["side"], one["bound"], one["unit"]) for one in numbers["rules"]}
    assert rules["ledger"] == (0, "at most", 0, "events without one fate")
    assert rules["verdict.max_latency_us usb"] == (90.0, "at most", 50.0, "us (p99)")
    assert rules["verdict.min_rate_hz"] == (100.0, "at least", 10.0, "events/s")
    assert "at most 50<" in page
    assert "Not judged, because the rig sets no limit: verdict.max_drop" in page


def test_faults_triggers_and_commands_are_marked_once_each():
    marked = [(one.label, one.lane, one.t_s, one.until_s) for one in happenings(full())]
    assert marked == [("F1", "fault", 0.2, 0.4), ("T1", "trigger", 0.5, None), ("C1", "command", 0.6, None)]


def test_the_fates_of_a_link_sum_to_what_it_was_given():
    found = fates(full())
    assert sum(one.events for one in found if one.link == "usb") == 100
    assert sum(one.events for one in found if not one.link) == 110
    assert {one.fate: one.events for one in found}["camera: FIFO full"] == 5


def test_a_link_without_camera_or_report_has_all_its_events(written):
    result = dataclasses.replace(EMPTY, ledger=ledger(gone=(60, 10, 30)))
    assert [one.events for one in fates(result)] == [100, 4, 6, 60, 10, 30]
    written(result)


def test_an_empty_run_has_a_report(written):
    page, numbers = written()
    assert "No event was raised, and nothing happened." in page
    assert "This rig has no link." in page
    assert numbers["timeline"]["on"] == []
    assert numbers["pixels"] == {"count": 200, "silent": 200, "busiest": []}


def test_an_incomplete_truth_file_makes_the_report_bad(written):
    page, numbers = written(there=Circumstances(truth_trouble="the disk is full"))
    assert numbers["verdict"] == "bad"
    assert "1 of 2 rules broken: truth file." in page


def test_names_of_others_are_no_html(written):
    result = full(NASTY)
    broken = dataclasses.replace(result.links[NASTY], state=NASTY, error=NASTY, file_troubles=(NASTY,))
    changes = (Change(1, NASTY, NASTY, NASTY), *result.changes)
    result = dataclasses.replace(result, links={NASTY: broken}, changes=changes, renderer=NASTY, scene_trouble=NASTY)
    rig = dataclasses.replace(load_rig("checkerboard"), name=NASTY, title=NASTY)
    made = Modelled((Part(NASTY, NASTY),), (Effect(NASTY, "modelled", NASTY),), notes=(NASTY,))
    page, numbers = written(result, seen_of(), rig, Circumstances(modelled=made))
    assert "<script" not in page
    assert "\x00" not in page
    assert numbers["title"] == NASTY


def test_a_long_run_with_many_happenings_has_a_small_page(written):
    faults = tuple(FaultRecord(k, "usb_silence", k * 1000, k * 1000 + 500) for k in range(20_000))
    link = dataclasses.replace(full().links["usb"], faults=faults)
    changes = tuple(Change(k * 1_000_000, "register", "SetRegion" * 9, "usb") for k in range(10_000))
    result = dataclasses.replace(full(), sim_seconds=1e5, links={"usb": link}, changes=changes, changes_beyond=5)
    seen = Observation((1280, 720))
    rng, events = np.random.default_rng(1), np.zeros(1_000_000, EVENT)
    events["t"] = np.linspace(0, 1e11, len(events))
    events["x"], events["y"] = rng.integers(0, 1280, len(events)), rng.integers(0, 720, len(events))
    seen.take(events)
    for k in range(12):
        seen.take(events[:0], rng.random((720, 1280), np.float32), 60_000 * (k + 1))
    page, numbers = written(result, seen)
    assert len(page) < 1_000_000
    assert len(numbers["timeline"]["happenings"]) == 2000
    assert "and 5 further changes" in page
    assert page.count("<img") == 8


def test_a_killed_run_leaves_no_verdict_of_an_earlier_one(written, tmp_path):
    written(full(), seen_of())
    begin_files(load_rig("checkerboard"), tmp_path, NOON)
    numbers = checked(json.loads((tmp_path / "report.json").read_text()))
    assert (numbers["verdict"], numbers["began"]) == ("unfinished", "2026-01-02T12:00:00+00:00")
    page = (tmp_path / "report.html").read_text(encoding="utf-8")
    assert "UNFINISHED" in page
    assert "GOOD" not in page
    assert {path.name for path in tmp_path.iterdir()} == {"report.html", "report.json"}
