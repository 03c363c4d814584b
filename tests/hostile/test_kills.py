"""Some kills of random processes at random moments; `kills.py` does as many as wanted."""

import random

import pytest

from tests.hostile.kills import kill_once

pytestmark = pytest.mark.system


@pytest.mark.long
@pytest.mark.socket
def test_a_killed_process_breaks_no_promise(tmp_path):
    draw = random.Random(5)
    assert {kill_once(draw, tmp_path) for _ in range(2)} <= {"link", "session"}
