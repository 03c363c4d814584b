"""Edges at given times."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EdgeKind
from transports.link.edges import EdgeTrain, ListedEdges

TRAINS = [
    EdgeTrain(EdgeKind.RISING, 100),
    EdgeTrain(EdgeKind.FALLING, 250),
    EdgeTrain(EdgeKind.PULSE, 100, 50, 4),
    EdgeTrain(EdgeKind.RISING, 1000, 500, None),
]
EXPECTED = [
    *[(100, 2, 0), (100, 4, 1), (150, 4, 2), (200, 4, 3), (250, 3, 4), (250, 4, 5)],
    *[(1000 + 500 * k, 2, 6 + k) for k in range(5)],
]


def test_trains_are_merged_in_time_order_and_numbered():
    edges = ListedEdges(TRAINS, channel=2).take(3000)
    assert [(e["t"], e["kind"], e["seq"]) for e in edges] == EXPECTED
    assert (edges["channel"] == 2).all()


@given(st.lists(st.integers(0, 3000), max_size=8).map(sorted))
def test_it_does_not_matter_how_they_are_asked_for(cuts):
    whole, source = ListedEdges(TRAINS).take(3000), ListedEdges(TRAINS)
    assert np.concatenate([source.take(until) for until in [*cuts, 3000]]).tobytes() == whole.tobytes()
    assert source.refused == 0
