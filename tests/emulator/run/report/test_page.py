"""The page of a run's report: the share of undersampled pixel-steps and the late steps, as the terminal shows them."""

import dataclasses
import re

import pytest

from emulator.cli.run import summary_lines
from emulator.rig.loading import load_rig
from emulator.rig.tables import Trigger, TriggerEdges
from emulator.run.outcome import Ledger, RunResult, RunStatus, judge
from emulator.run.pacing import Lateness
from emulator.run.report.content import ReportContent
from emulator.run.report.figures import timeline
from emulator.run.report.files import write_report
from emulator.run.report.observation import Observation
from transports.link.feed import EdgeReport
from transports.link.report import LinkReport

RESULT = RunResult(1.0, 1.0, 101, 100, Ledger(0, 0, 0, 0), Lateness())


@pytest.fixture
def page(tmp_path):
    rig = load_rig("checkerboard")

    def page_of(result):
        reported = ReportContent(rig, result, Observation((20, 10)), judge(rig.verdict, result), {}, "1.0")
        path, *_ = write_report(reported, tmp_path)
        return path.read_text()

    return page_of


@pytest.mark.parametrize(("share", "told"), [(0.25, "0.25 of the solved"), (0.02, "0.02 of"), (None, "not measured")])
def test_the_share_of_undersampled_pixel_steps_is_in_every_report(share, told, page):
    text = page(dataclasses.replace(RESULT, undersampled_share=share))
    assert re.search(rf">undersampled</th><td[^>]*>{told}", text)


@pytest.mark.parametrize(
    "late",
    [
        {"lateness": dataclasses.replace(RESULT.lateness, steps_stretched=30)},
        {"lateness": dataclasses.replace(RESULT.lateness, worst_gap_us=9e6), "max_late_us": 1e6},
    ],
)
def test_a_late_run_has_no_opposite_advice(late):
    result = dataclasses.replace(RESULT, undersampled_share=0.25, **late)
    shown = "\n".join(summary_lines(load_rig("checkerboard"), result))
    assert "the run was late" in shown
    assert "shorten run.step_us" not in shown


@pytest.mark.parametrize("share", [0.25, 0.02])
def test_the_report_has_the_advice_of_the_terminal(share, page):
    result = dataclasses.replace(RESULT, undersampled_share=share)
    lines = summary_lines(load_rig("checkerboard"), result)
    advice = [line for line in lines if line.startswith("light frames too far apart")]
    assert len(advice) == (share > 0.1)
    text = page(result)
    assert ("light frames too far apart" in text) is bool(advice)
    assert all(f"<p>{line}</p>" in text for line in advice)


def test_the_terminal_and_the_report_have_the_reason_why_a_scene_ended(page):
    dark = dataclasses.replace(RESULT, scene_trouble="the renderer closed the connection")
    lines = summary_lines(load_rig("checkerboard"), dark)
    assert "NOT GOOD: scene: the renderer closed the connection" in lines
    assert "the renderer closed the connection" in page(dark)


def test_the_last_line_of_the_summary_is_the_verdict():
    dark = dataclasses.replace(RESULT, scene_trouble="the renderer closed the connection")
    last = [[*summary_lines(load_rig("checkerboard"), result)][-1] for result in (RESULT, dark)]
    assert last == ["good: 1 of 1 rules kept", "NOT GOOD: 1 of 2 rules broken: scene"]


def test_edges_that_the_rig_gives_are_marked_at_their_times():
    lanes = timeline_of(Trigger(edges=(TriggerEdges(at_ms=250.0, every_ms=250.0, count=2), TriggerEdges(at_ms=750.0))))
    assert [float(x) for x in re.findall(r'class="edge" x="([\d.]+)"', lanes)] == pytest.approx(
        [78 + 628 * share - 1.5 for share in (0.25, 0.5, 0.75)], abs=0.1
    )
    assert "triggers; edges taken: 3" in lanes


def timeline_of(trigger, seconds=1.0):
    rig, seen = dataclasses.replace(load_rig("checkerboard"), trigger=trigger), Observation((20, 10))
    links = {"usb": LinkReport("open", edges=EdgeReport(taken=3))}
    seen.renew(RunStatus(0.4, 0.4, 0, 0, Lateness(), links))
    result = dataclasses.replace(RESULT, sim_seconds=seconds)
    return timeline(ReportContent(rig, result, seen, (), {}, "1.0"), [])
