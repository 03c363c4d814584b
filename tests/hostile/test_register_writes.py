"""Any values in any registers of a DAVIS346 while its streams run; the full size by EVSTIM_REGISTER_WRITES=1000000."""

import os

import pytest

from tests.hostile.register_writes import Campaign

WRITES = int(float(os.environ.get("EVSTIM_REGISTER_WRITES", "10000")))


@pytest.mark.system
@pytest.mark.timeout(600 + WRITES // 100)
def test_no_write_hurts_and_the_camera_is_exact_again_afterwards():
    campaign = Campaign(seed=WRITES)
    while campaign.counts.writes < WRITES:
        campaign.batch(64)
    reached = campaign.counts
    assert min(reached.events, reached.samples, reached.edges) > 100, reached
    assert min(reached.frames, reached.refused) > 3, reached
    campaign.assert_exact_again()
