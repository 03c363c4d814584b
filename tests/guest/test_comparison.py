"""The judge itself: it must see one wrong bit in one event."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.events import EVENT, Events
from tests.guest.comparison import assert_same, load_seen

OFFSET_US = 1_795_149_671_255_963


def events() -> Events:
    made = np.zeros(1000, EVENT)
    made["t"] = np.arange(1000) * 7
    made["x"], made["y"], made["on"] = np.arange(1000) % 346, np.arange(1000) % 260, np.arange(1000) % 2
    return made


def test_the_beginning_of_what_was_delivered_is_the_same() -> None:
    seen = events()[:900].copy()
    seen["t"] += np.uint64(OFFSET_US)
    assert_same(seen, events(), offset_us=OFFSET_US)


@pytest.mark.parametrize("field", ["t", "x", "y", "on"])
def test_one_wrong_field_is_found_and_shown(field: str) -> None:
    seen = events()
    seen[field][500] = not seen[field][500] if field == "on" else seen[field][500] + 1
    with pytest.raises(AssertionError, match="1 of 1000 events differ, the first at 500"):
        assert_same(seen, events(), offset_us=0)


@pytest.mark.parametrize(
    "seen",
    [np.delete(events(), 10), np.insert(events(), 10, events()[10]), events()[1:], events()[::-1]],
    ids=["lost", "twice", "late", "reversed"],
)
def test_a_lost_repeated_or_moved_event_is_found(seen: Events) -> None:
    with pytest.raises(AssertionError, match=r"differ|only 1000 delivered"):
        assert_same(seen, events(), offset_us=0)


def test_a_client_that_saw_nothing_leaves_an_empty_view(tmp_path: Path) -> None:
    nothing = np.empty(0)
    np.savez(tmp_path / "seen.npz", t=nothing, x=nothing, y=nothing, on=nothing)
    assert len(load_seen(tmp_path / "seen.npz")) == 0
