"""Any values in any registers of a DAVIS346 while its streams run; the full size by EVSTIM_REGISTER_WRITES=1000000."""

import os

import pytest

from tests.hostile.register_writes import Campaign

WRITES = int(float(os.environ.get("EVSTIM_REGISTER_WRITES", "10000")))
STEPS, STEP_US = 400, 1000


@pytest.mark.timeout(600 + WRITES // 100)
def test_no_write_hurts_and_the_camera_is_exact_again_afterwards():
    campaign = Campaign(seed=WRITES)
    while campaign.counts.writes < WRITES:
        campaign.batch(64)
    reached = campaign.counts
    assert min(reached.events, reached.samples, reached.edges) > 100, reached
    assert min(reached.frames, reached.refused) > 3, reached
    campaign.start_anew()
    before = campaign.camera.counters
    offered = [campaign.step(STEP_US) for _ in range(STEPS)]
    campaign.step(STEP_US)
    campaign.read()
    counts, after = campaign.counts, campaign.camera.counters
    assert counts.events == sum(len(events) for events, _ in offered) + 25
    assert counts.edges == sum(len(edges) for _, edges in offered) + 4
    assert 400 <= counts.samples <= 402
    assert counts.frames == 10
    assert after.dropped_fifo == before.dropped_fifo
    assert campaign.host.decoder.frames_incomplete == 0
