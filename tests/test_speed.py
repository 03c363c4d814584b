"""The ratchet of speed: which numbers it lets pass."""

import importlib.util
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
