"""The judge of runs that are shared: each client gets the part of the record that is its own, each test its failure."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import numpy as np
import pytest

from firmware_protocol.events import EVENT, empty_edges
from tests.guest.environments import DRIVERS
from tests.guest.running_rig import Delivered
from tests.guest.streaming import Seen
from tests.guest.turns import Turns, parts_of

DV2, _, ND = DRIVERS
AT_ONCE_US, DELAYED_US = 3, 1_000_003


def part(first_us: int) -> Delivered:
    events = np.zeros(2, EVENT)
    events["t"] = first_us, first_us + 5
    nothing = np.empty(0)
    return Delivered(events, [0], empty_edges(0), [0], nothing, [0], nothing, [0])


def seen(driver: object) -> Seen:
    nothing = np.empty(0)
    return Seen(driver, {}, np.zeros(0, EVENT), empty_edges(0), *[nothing] * 4)


def test_what_came_before_a_late_timestamp_reset_is_nobodys() -> None:
    parts = [part(DELAYED_US), part(DELAYED_US), part(AT_ONCE_US), part(AT_ONCE_US)]
    assert parts_of([seen(ND), seen(DV2), seen(DV2)], parts) == [parts[0], parts[2], parts[3]]


def test_a_start_of_nobodys_is_found() -> None:
    with pytest.raises(AssertionError, match="began anew 3 times for 2 clients"):
        parts_of([seen(ND), seen(ND)], [part(DELAYED_US)] * 3)


def test_a_turn_that_fails_fails_what_judges_it_alone() -> None:
    def take(name: str) -> str:
        if name == "bad":
            raise RuntimeError("no camera")
        return name.upper()

    turns = Turns(nullcontext(), ["one", "bad", "other"], take)
    assert (turns.result("one"), turns.result("other")) == ("ONE", "OTHER")
    with pytest.raises(RuntimeError, match="no camera"):
        turns.result("bad")


def test_no_part_is_given_where_a_turn_failed() -> None:
    def take(name: int) -> Seen:
        if name:
            raise RuntimeError("no camera")
        return seen(ND)

    rig = nullcontext()
    rig.delivered = SimpleNamespace(turns=[part(DELAYED_US)])
    with pytest.raises(AssertionError, match="a turn failed"):
        Turns(rig, [0, 1], take).delivered(0)
    assert Turns(rig, [0], take).delivered(0) is rig.delivered.turns[0]
