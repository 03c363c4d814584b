"""The loop of a reception, and its result for each kind of link."""

import pytest

from transports.can_bus.node import CanReception
from transports.link.pacing import FakeClock
from transports.reception import Arrivals, Reception, receive


class Lost(Exception):
    pass


class Side:
    """Other side of a link that is lost at a step, if any."""

    def __init__(self, turns, lost_at=None):
        self.turns, self.lost_at = turns, lost_at
        self.steps = []

    def step(self, name):
        self.steps.append(name)
        if name == self.lost_at:
            raise Lost

    def receive(self):
        return receive(
            lambda: Reception(events=self.steps.count("turn")),
            lambda now: now.events < self.turns,
            lambda: self.step("turn"),
            stop=lambda: self.step("stop"),
            lost=Lost,
        )


def test_a_reception_turns_until_its_limit_and_then_stops():
    side = Side(3)
    assert side.receive() is False
    assert side.steps == ["turn", "turn", "turn", "stop"]


def test_a_limit_that_is_reached_before_the_first_turn():
    side = Side(0)
    assert side.receive() is False
    assert side.steps == ["stop"]


@pytest.mark.parametrize(("lost_at", "steps"), [("turn", ["turn"]), ("stop", ["turn", "turn", "stop"])])
def test_the_loss_of_the_other_side_ends_a_reception(lost_at, steps):
    side = Side(2, lost_at)
    assert side.receive() is True
    assert side.steps == steps


def test_other_errors_are_raised():
    def turn():
        raise OSError

    with pytest.raises(OSError):
        receive(Reception, lambda _: True, turn, lost=Lost)


def test_the_counts_so_far_are_in_the_reception_of_each_kind():
    clock = FakeClock(0)
    arrivals = Arrivals(clock)
    clock.advance(500_000_000)
    reception = arrivals.reception(Reception, gone=True, faults=3)
    assert reception == Reception(0, 0, 0.5, None, 0, gone=True, faults=3)


def test_a_bus_that_ends_after_the_cameras_stop_is_not_early():
    assert Reception(gone=True).is_early
    assert CanReception(gone=True).is_early
    assert not CanReception(gone=True, ended=True).is_early
