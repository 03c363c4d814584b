"""Rules of success and how far a run is from breaking them."""

import pytest

from emulator.campaign.loading import margin, parse_rule, succeeds

ROW = {"outcome": "ok", "verdict": True, "program.exit": 0, "result.error": 0.04, "result.mode": "fine", "n": 10}


@pytest.mark.parametrize(
    ("rule", "kept"),
    [
        ("verdict", True),
        ("program", True),
        ("result.error < 0.05", True),
        ("result.error < 0.04", False),
        ("result.error <= 0.04", True),
        ("result.error >= 0.05", False),
        ("n > 9", True),
        ("n == 10", True),
        ("n != 10", False),
        ("verdict == true", True),
        ("result.mode == fine", True),
        ('result.mode != "fine"', False),
        ("result.mode > 3", False),
        ("n == ten", False),
        ("result.missing < 1", False),
        ("result.missing != 1", False),
    ],
)
def test_rules(rule, kept):
    assert succeeds([parse_rule(rule)], ROW) is kept


def test_all_rules_must_be_kept_and_the_run_have_ended():
    rules = [parse_rule("n > 9"), parse_rule("result.error < 0.05")]
    assert succeeds(rules, ROW)
    assert not succeeds(rules, {**ROW, "n": 9})
    assert not succeeds(rules, {**ROW, "outcome": "crashed"})


def test_without_rules_the_verdict_decides():
    assert succeeds([], ROW)
    assert not succeeds([], {**ROW, "verdict": False})


def test_the_margin_is_that_of_the_nearest_rule():
    rules = [parse_rule(text) for text in ("verdict", "n > 8", "result.error < 0.05")]
    assert margin(rules, ROW) == pytest.approx(0.2)  # 0.01 of 0.05; n is 2 of 8 above
    assert margin(rules, {**ROW, "n": 6}) == pytest.approx(-0.25)
    assert margin([parse_rule("n > 0")], ROW) == 10
    assert margin([parse_rule("verdict")], ROW) is None


@pytest.mark.parametrize("text", ["n", "n >", "n ~ 3", "n > x", "n < true", "n < nan", 3])
def test_what_is_no_rule_is_refused(text):
    with pytest.raises(ValueError, match=r"expected|needs a number"):
        parse_rule(text)
