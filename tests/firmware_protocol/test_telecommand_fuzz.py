"""Valid telecommands at random moments: nothing raises, the ledgers balance, and what is decoded is what was sent.

The long version: `python -m tests.firmware_protocol.telecommand_fuzz 1000000`.
"""

import pytest
from telecommand_fuzz import NAMES, run


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.parametrize("name", NAMES)
def test_valid_telecommands_at_random_moments_hurt_nothing(name):
    told, delivered = run(name, 600, seed=7)
    assert told >= 600
    assert delivered > 50
