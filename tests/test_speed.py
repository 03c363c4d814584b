"""The ratchet of speed: which numbers it lets pass."""

import importlib.util
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SPEC = importlib.util.spec_from_file_location("speed", ROOT / ".ci" / "speed.py")
speed = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(speed)


@pytest.mark.parametrize(
    ("quotient", "number", "slack", "fails"),
    [
        (2.9, 2.0, 1.5, False),
        (3.1, 2.0, 1.5, True),
        (1.07, 1.0, 1.08, False),
        (1.09, 1.0, 1.08, True),
        (0.09, 0.01, 1.5, False),  # the overhead of calls
        (0.11, 0.01, 1.5, True),
    ],
)
def test_a_part_fails_beyond_its_number_and_the_slack(quotient, number, slack, fails):
    assert bool(speed.slower({"eros pixels": quotient}, {"eros pixels": number}, slack)) == fails


def test_a_part_without_a_number_fails():
    assert set(speed.slower({"eros pixels": 0.001}, {}, 1.5)) == {"eros pixels"}


def test_speed_toml_has_a_number_for_each_part_of_the_short_form():
    table = tomllib.loads((ROOT / "speed.toml").read_text())
    parts = ("drawing", "pixels", "read-out")
    assert set(table["quotients"]) == {f"{rig} {part}" for rig in speed.RIGS for part in parts}
    assert all(number > 0 for number in table["quotients"].values())
