"""A bounded `usbip_soak`: a few million events, and a quiet camera through a wrap of 2^31 us; how it finds faults."""

import pytest

from tests.hostile.usbip_soak import Plan, soak

MIB = 1 << 20


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.socket
@pytest.mark.timeout(300)
@pytest.mark.parametrize(
    "plan",
    [Plan(events=3_000_000, loop=300_000, gap_us=3), Plan(device_us=(1 << 31) + 10**8, loop=50_000, gap_us=20_000)],
    ids=["dense", "through 2^31 us"],
)
def test_every_event_is_as_recorded_and_memory_stays(plan):
    outcome = soak(plan)
    outcome.check()
    assert outcome.events >= plan.events
    assert outcome.device_us >= plan.device_us
    assert all(grown < 8 * MIB for grown in outcome.memory.grown().values()), outcome.memory.told()
