"""The rules of a verdict: each is kept on one side of its limit and broken on the other."""

import dataclasses

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.rig.tables import Verdict
from emulator.run.outcome import Ledger, LinkLedger, RunResult, good, judge
from emulator.run.pacing import Lateness
from firmware_protocol.device.fates import Fates
from transports.link.deliveries import LatencyHistogram, LatencySummary
from transports.link.report import LinkReport

CAMERA = Fates(offered=1000, not_running=100, dropped_fifo=30, delivered=870)
LINK = LinkReport("", delivered=860, dropped=10, camera=CAMERA, latency=LatencySummary(100.0, 900.0, 950.0))
LEDGER = Ledger(1000, 0, 0, 1000, (LinkLedger("usb", 860, 10, 130),))
RESULT = RunResult(2.0, 2.0, 10, 10, LEDGER, Lateness(), {"usb": LINK}, undersampled_share=0.2)


def broken(rules, result=RESULT):
    return [one.rule for one in judge(rules, result) if not one.good]


def test_a_sound_run_is_good():
    assert broken(Verdict()) == []
    assert good(judge(Verdict(), RESULT))


@pytest.mark.parametrize(
    ("kept", "not_kept", "rule"),
    [
        ({"max_drop": 0.05}, {"max_drop": 0.04}, "verdict.max_drop usb"),  # 40 of 900
        ({"min_rate_hz": 500}, {"min_rate_hz": 501}, "verdict.min_rate_hz"),
        ({"max_rate_hz": 500}, {"max_rate_hz": 499}, "verdict.max_rate_hz"),
        ({"max_latency_us": 900}, {"max_latency_us": 899}, "verdict.max_latency_us usb"),
        ({"max_undersampled": 0.2}, {"max_undersampled": 0.19}, "verdict.max_undersampled"),
    ],
)
def test_a_rule_has_two_sides(kept, not_kept, rule):
    assert broken(Verdict(**kept)) == []
    assert broken(Verdict(**not_kept)) == [rule]


def test_what_no_rule_forgives():
    off = dataclasses.replace(RESULT, ledger=dataclasses.replace(LEDGER, raised=1001))
    assert broken(Verdict(), off) == ["ledger"]
    dead = dataclasses.replace(RESULT, links={"usb": dataclasses.replace(LINK, error="its process died")})
    assert broken(Verdict(), dead) == ["link usb"]
    dark = dataclasses.replace(RESULT, scene_trouble="the renderer closed the connection")
    assert broken(Verdict(), dark) == ["scene"]
    assert not dark.good
    late = dataclasses.replace(RESULT, lateness=Lateness(), max_late_us=1000.0)
    late.lateness.add(2_000_000, 1)
    assert broken(Verdict(), late) == ["in real time"]
    assert not late.good


def late_run(late, steps, **limits):
    """Return a run of which so many steps were late, each by 1 ms."""
    lateness = Lateness()
    for _ in range(late):
        lateness.add(1_000_000, 1)
    return dataclasses.replace(RESULT, steps=steps, lateness=lateness, **limits)


def test_a_run_that_is_late_too_often_is_bad_however_little():
    limits = {"max_late_us": 1e6, "max_late_share": 0.01}
    assert broken(Verdict(), late_run(10, 1000, **limits)) == []
    often = late_run(370, 935, **limits)
    assert broken(Verdict(), often) == ["steps in time"]
    assert not often.good
    (judgement,) = (one for one in judge(Verdict(), often) if not one.good)
    assert "370 of 935 steps late (0.396)" in judgement.finding
    assert "run.max_late_share is 0.01" in judgement.finding
    assert broken(Verdict(), late_run(370, 935, max_late_us=0.0, max_late_share=0.01)) == []
    assert broken(Verdict(), late_run(0, 935, max_late_us=1e6, max_late_share=0.0)) == []


def test_a_latency_above_a_fifth_of_a_second_breaks_its_limit():
    latencies = LatencyHistogram()
    latencies.add(np.full(100, 19e6))
    slow = dataclasses.replace(RESULT, links={"usb": dataclasses.replace(LINK, latency=latencies.summary())})
    assert broken(Verdict(max_latency_us=20e6), slow) == []
    assert broken(Verdict(max_latency_us=1e6), slow) == ["verdict.max_latency_us usb"]


@pytest.mark.parametrize("table", ["max_drop = 1.5", "min_rate_hz = -1", "min_rate_hz = 5\nmax_rate_hz = 4", "x = 1"])
def test_a_wrong_table_is_refused_by_its_key(table):
    text = f'[scene]\nkind = "checkerboard"\n[verdict]\n{table}\n'
    with pytest.raises(RigError, match="verdict"):
        parse_rig(text, "a.toml", "a")
