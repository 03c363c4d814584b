"""The frame of AEDAT 4.0 files, against files of faery and any damage."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.recordings.aedat4 import MAGIC, Aedat4Head, packet_at
from tests.transports.recording.samples import sample_events, write


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    path = tmp_path_factory.mktemp("aedat4") / "a.aedat4"
    write(path, "aedat4", sample_events()[:2000], piece=100)
    return path.read_bytes()


def test_the_packets_reach_to_the_table(finished):
    head = Aedat4Head(finished)
    at, packets = head.packets_at, 0
    while size := packet_at(finished[at : at + 8], head.table_at - at):
        at, packets = at + size, packets + 1
    assert at == head.table_at
    assert packets > 5
    assert packet_at(finished[at : at + 7], 100) == 0


def test_the_header_can_say_that_there_is_no_table(finished):
    head = Aedat4Head(finished)
    changed = Aedat4Head(head.unfinished() + finished[head.packets_at :])
    assert (changed.table_at, changed.packets_at) == (-1, head.packets_at)
    differs = np.flatnonzero(np.frombuffer(head.unfinished(), "u1") != np.frombuffer(finished[: head.packets_at], "u1"))
    assert 0 < len(differs) <= 8


@given(st.data())
def test_any_damage_of_the_header_is_refused_or_read(finished, data):
    at = data.draw(st.integers(0, 200))
    put = data.draw(st.binary(min_size=1, max_size=20))
    changed = finished[:at] + put + finished[at + len(put) :]
    changed = changed[: data.draw(st.integers(0, 6000))]
    refused = ""
    try:
        head = Aedat4Head(changed)
        assert len(MAGIC) < head.packets_at <= len(changed)
        assert len(head.unfinished()) == head.packets_at
    except ValueError as error:
        refused = str(error)
    assert not refused or "header" in refused or "AEDAT 4.0" in refused
