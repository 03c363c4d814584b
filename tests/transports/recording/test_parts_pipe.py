"""Parts on a pipe: whole, in any pieces of bytes."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.events import EDGE, EVENT
from firmware_protocol.recordings.part import IMU, Facts, Frame, Part
from transports.recording.part import (
    PipeReader,
    Restart,
    encoded_end,
    encoded_facts,
    encoded_part,
    encoded_restart,
    facts_of,
)

FRAME = Frame(5, 3, 4, np.arange(12, dtype=np.uint16).reshape(3, 4))
PART = Part(np.ones(3, EVENT), np.ones(2, EDGE), np.ones(1, IMU), (FRAME, FRAME))
FACTS = Facts((346, 260), "DAVIS346", 7, frozenset({"imu"}))


@given(st.integers(1, 500))
def test_a_part_arrives_as_one_whatever_the_pieces(piece):
    told = (encoded_facts(FACTS), encoded_part(PART), encoded_restart(-8), encoded_part(Part()), encoded_end(a=1))
    data = b"".join(b"".join(messages) for messages in told)
    reader = PipeReader()
    got = [message for k in range(0, len(data), piece) for message in reader.feed(data[k : k + piece])]
    assert len(got) == 4
    assert facts_of(got[0]) == FACTS
    for name in ("events", "edges", "imu"):
        np.testing.assert_array_equal(getattr(got[1], name), getattr(PART, name))
    assert [frame.t_us for frame in got[1].frames] == [5, 5]
    np.testing.assert_array_equal(got[1].frames[1].pixels, FRAME.pixels)
    assert got[2] == Restart(-8)
    assert got[3] == {"kind": "Z", "a": 1}


@pytest.mark.parametrize("data", [b"Q\1\0\0\0.", b"E\xff\xff\xff\xff"])
def test_what_is_none_of_ours_is_refused(data):
    with pytest.raises(ValueError, match="no part of a recording"):
        list(PipeReader().feed(data))
