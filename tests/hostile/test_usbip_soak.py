"""A bounded `usbip_soak`: a few million events, and a quiet camera through a wrap of 2^31 us; how it finds faults."""

import numpy as np
import pytest

from tests.hostile.looped import Follower, Looped
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


@pytest.mark.parametrize("fault", ["lost", "twice", "late", "swapped"])
def test_the_comparison_sees_what_is_wrong(fault):
    looped = Looped(1000, 30)
    events = looped.stretch(700, 2500)
    follower = Follower(looped)
    follower.take(events[:1500])
    rest = events[1500:].copy()
    if fault == "lost":
        rest = np.delete(rest, 300)
    elif fault == "twice":
        rest = np.insert(rest, 300, rest[300])
    elif fault == "late":
        rest["t"][300:] += 1 << 15
    else:
        rest["on"][300] = not rest["on"][300]
    with pytest.raises(AssertionError, match="differ after 1500"):
        follower.take(rest)


def test_a_loop_goes_on_where_it_ended():
    looped = Looped(500, 20)
    whole = looped.stretch(0, 1500)
    assert np.all(np.diff(whole["t"].astype(np.int64)) >= 0)
    assert int(whole["t"][1000]) == 2 * looped.round_us
    assert np.array_equal(np.concatenate([looped.stretch(0, 700), looped.stretch(700, 800)]), whole)
