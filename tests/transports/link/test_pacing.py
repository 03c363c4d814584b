"""Clocks."""

from transports.link.pacing import FakeClock, MonotonicClock


def test_a_fake_clock_moves_only_when_told():
    clock = FakeClock(5)
    assert clock.now_ns() == clock.now_ns() == 5
    clock.advance(10)
    clock.sleep_until(12)
    assert clock.now_ns() == 15
    clock.sleep_until(40)
    assert clock.now_ns() == 40


def test_the_monotonic_clock_wakes_after_its_deadline():
    clock = MonotonicClock()
    deadline_ns = clock.now_ns() + 2_000_000
    clock.sleep_until(deadline_ns)
    assert clock.now_ns() >= deadline_ns
    clock.sleep_until(0)  # a deadline that has passed does not wait
    assert clock.now_ns() >= deadline_ns
