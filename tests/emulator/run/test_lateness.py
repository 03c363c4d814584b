"""Keeping up with real time."""

import dataclasses

import pytest

from emulator.cli import demo
from emulator.cli.run_summary import lateness_lines
from emulator.plan.step_control import FixedSteps
from emulator.rig.loading import load_rig
from emulator.run.outcome import Ledger, RunResult
from emulator.run.pacing import LONGEST_STRETCH, Lateness, StepRule


def test_a_run_in_time_keeps_its_step():
    rule = StepRule(FixedSteps(1000))
    for _ in range(5):
        rule.follow(-10, 500)
    assert rule.step_ns == 1000


def test_a_run_behind_takes_longer_steps_and_returns_to_its_own():
    rule = StepRule(FixedSteps(1000))
    lengths = []
    for gap in (1500, 1500, 1500, 1500, 500, 0, 0, 0, 0):
        rule.follow(gap, 1200)  # a picture costs the same however long the step
        lengths.append(rule.step_ns)
    assert lengths == [2000, 4000, 8000, 8000, 8000, 4000, 2000, 1000, 1000]
    assert max(lengths) == 1000 * LONGEST_STRETCH


def test_a_longer_step_that_saves_nothing_is_left_again():
    rule = StepRule(FixedSteps(1000))
    lengths = []
    for _ in range(40):
        lengths.append(rule.step_ns)
        rule.follow(5000, 1200 * rule.stretch**2)  # twice as long costs four times as much
    assert set(lengths) == {1000, 2000}
    assert lengths.count(1000) > 35


def test_lateness_counts_late_frames_and_keeps_the_worst():
    lateness = Lateness()
    for gap_ns, stretch in ((-5000, 1), (9000, 2), (2000, 1)):
        lateness.add(gap_ns, stretch)
    told = lateness.as_json()
    assert told.pop("lead_needed_us")["max"] == 9.0
    assert told == {"frames_late": 2, "worst_gap_us": 9.0, "steps_stretched": 1, "processor_share": 1.0}


def test_the_lead_needed_is_from_when_computing_was_to_begin_until_ready():
    lateness = Lateness()
    for gap_ns, lead_ns in ((-3_000_000, 5_000_000), (-1_000_000, 5_000_000), (7_000_000, 10_000_000)):
        lateness.add(gap_ns, 1, lead_ns)
    needed = lateness.lead_needed_us
    assert (needed.p50, needed.max) == (pytest.approx(4000.0, abs=20.0), 17_000.0)
    assert Lateness().lead_needed_us.p50 is None


def result_of(late, steps, rig):
    lateness = Lateness()
    for _ in range(late):
        lateness.add(2_000_000, 1)
    limits = {"max_late_us": rig.run.max_late_ms * 1000, "max_late_share": rig.run.max_late_share}
    return RunResult(1.0, 1.0, steps + 1, steps, Ledger(0, 0, 0, 0), lateness, **limits)


def test_the_summary_says_which_limit_was_broken_and_by_how_much():
    rig = load_rig("loopback")
    (line,) = lateness_lines(rig, result_of(370, 935, rig))
    assert line.startswith("NOT IN REAL TIME: 370 of 935 steps (39.6%) were late, and run.max_late_share is 0.01. Take")
    (line,) = lateness_lines(rig, result_of(5, 935, rig))
    assert line.startswith("late: 5 of 935 steps, the worst by 2000 us")
    assert lateness_lines(rig, result_of(0, 935, rig)) == []
    rig = dataclasses.replace(rig, run=dataclasses.replace(rig.run, max_late_ms=1.0, max_late_share=1.0))
    (line,) = lateness_lines(rig, result_of(5, 935, rig))
    assert line.startswith("NOT IN REAL TIME: the worst step was 0.002 s late, and run.max_late_ms is 1. Take")


def test_beside_other_programs_the_rig_need_not_change():
    rig = load_rig("loopback")
    result = result_of(370, 935, rig)
    result.lateness.computing_ns, result.lateness.processor_ns = 10, 9
    assert "Take a longer run.step_us" in lateness_lines(rig, result)[0]
    result.lateness.processor_ns = 4
    (line,) = lateness_lines(rig, result)
    assert "Other programs had the processor for 60% of the time" in line
    assert "step_us" not in line
    assert "rig need not change" in line


def test_a_demo_judges_events_and_mentions_a_slow_machine():
    rig = demo._on_a_free_port(load_rig("checkerboard"))
    late = Lateness(frames_late=99, worst_gap_us=9e6)
    result = RunResult(2.0, 2.8, 100, 99, Ledger(0, 0, 0, 0), late, max_late_us=rig.run.max_late_ms * 1000)
    assert result.good
    equal = {"sent": 5, "received": 5, "equal": True}
    late_line = "all events are equal; this machine was slower than real time by 1.4"
    assert late_line in demo._verdict_lines(result, equal, True)
    in_time = dataclasses.replace(result, wall_seconds=2.05)
    assert "all events are equal" in demo._verdict_lines(in_time, equal, True)
