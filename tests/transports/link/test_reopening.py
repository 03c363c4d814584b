"""Attempts to open again what was lost, with a clock that the test moves."""

import asyncio
import itertools

from transports.link.endpoint import Reopening
from transports.link.pacing import FakeClock

PERIOD_NS = 1000


async def test_attempts_follow_each_other_a_period_apart_until_one_succeeds():
    clock, attempts = FakeClock(10_000), []

    async def attempt():
        attempts.append(clock.now_ns())
        if len(attempts) < 3:
            raise OSError(f"attempt {len(attempts)} failed")
        return "port"

    again = Reopening(clock, PERIOD_NS, attempt)
    again.lost("unplugged")
    assert again.why == "unplugged"
    found = []
    for _ in range(60):
        if (opened := again.poll()) is not None:
            found.append((clock.now_ns(), opened))
            break
        await asyncio.sleep(0)
        clock.advance(100)
    why = again.why
    assert len(attempts) == 3
    assert attempts[0] == 11_000
    assert all(later - earlier >= PERIOD_NS for earlier, later in itertools.pairwise(attempts))
    assert [opened for _, opened in found] == ["port"]
    assert why == "attempt 2 failed"


def test_one_attempt_at_a_time_and_none_after_the_end():
    async def work():
        begun, ended = [], []

        async def attempt():
            begun.append(1)
            try:
                await asyncio.Event().wait()
            finally:
                ended.append(1)

        again = Reopening(FakeClock(), PERIOD_NS, attempt)
        for _ in range(5):
            assert again.poll() is None
            await asyncio.sleep(0)
        assert (begun, ended) == ([1], [])
        await again.close()
        return len(ended)  # now: the end of the loop cancels it too

    assert asyncio.run(work()) == 1
