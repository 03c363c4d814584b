"""Keeping up with real time."""

import pytest

from emulator.plan.step_control import FixedSteps
from emulator.run.lateness import LONGEST_STRETCH, Lateness, StepRule


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
    assert told == {"frames_late": 2, "worst_gap_us": 9.0, "steps_stretched": 1}


def test_the_lead_needed_is_from_when_computing_was_to_begin_until_ready():
    lateness = Lateness()
    for gap_ns, lead_ns in ((-3_000_000, 5_000_000), (-1_000_000, 5_000_000), (7_000_000, 10_000_000)):
        lateness.add(gap_ns, 1, lead_ns)
    needed = lateness.lead_needed_us
    assert (needed.p50, needed.max) == (pytest.approx(4000.0, abs=20.0), 17_000.0)
    assert Lateness().lead_needed_us.p50 is None


def test_a_step_must_last():
    with pytest.raises(ValueError, match="at least 1 ns"):
        FixedSteps(0)
