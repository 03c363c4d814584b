"""One damaged bit or byte costs at most two messages, is always counted, and never makes a message up."""

import pytest
from link_damage import survey

from firmware_protocol.packets.profile import PROFILES

TRIES = 1000


@pytest.mark.parametrize("name", [name for name in PROFILES if "-" in name or name == "fprime"])
def test_one_damaged_byte_costs_at_most_two_messages_and_makes_none_up(name):
    lost, wrong, untold = survey(name, TRIES, seed=1)
    assert sum(lost.values()) == TRIES
    assert max(lost) <= 2
    assert wrong == 0
    assert untold == 0
