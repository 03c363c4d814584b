"""A short run of what `fuzz.py` does at length."""

import pytest

from tests.firmware_protocol.c.fuzz import PROFILES, damage_one_in_three, random_bytes


def test_random_bytes_bring_no_crash_and_no_packet(library):
    assert random_bytes(library, 100_000) == 0


@pytest.mark.system
@pytest.mark.parametrize("mode", PROFILES)
def test_one_fault_costs_at_most_two_frames_and_is_counted(library, mode):
    lost_by = damage_one_in_three(library, mode, 2000)
    assert sum(lost_by) == 2000
    assert lost_by[1] > 1500
    assert lost_by[3] == 0
