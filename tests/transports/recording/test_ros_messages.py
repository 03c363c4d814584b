"""Messages of dvs_msgs: any bytes, and the layout that CDR asks for."""

import struct

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.transports.recording.samples import SIZE, sample_events
from transports.recording.rosbag import array_events, event_array


@given(st.integers(1, 40), st.booleans())
def test_an_array_is_read_back(count, cdr):
    events = sample_events()[2000 : 2000 + count]
    read, size = array_events(event_array(events, SIZE, 10**15, 3, cdr=cdr), cdr=cdr)
    read["t"] -= np.uint64(10**15)
    np.testing.assert_array_equal(read, events)
    assert size == SIZE


def test_cdr_aligns_each_time_to_four_bytes():
    message = event_array(sample_events()[:2], SIZE, 0, 0, cdr=True)
    start = 4 + 8 + 4 + 8 + 12  # representation, stamp, frame_id, sizes and length
    assert struct.unpack_from("<HHII?", message, start)[2] == 20
    assert struct.unpack_from("<HHxxII?", message, start + 14)[2] == 20
    assert len(message) == start + 13 + 16


@given(st.binary(max_size=120), st.booleans())
def test_any_bytes_are_read_or_refused(data, cdr):
    whole = event_array(sample_events()[:3], SIZE, 0, 0, cdr=cdr)
    for message in (data, whole[: len(data)], whole[:20] + data):
        refused = ""
        try:
            array_events(message, cdr=cdr)
        except ValueError as error:
            refused = str(error)
        assert not refused or "a message of events" in refused


@pytest.mark.parametrize("cdr", [True, False])
def test_a_cut_message_is_refused(cdr):
    message = event_array(sample_events()[:3], SIZE, 0, 0, cdr=cdr)
    with pytest.raises(ValueError, match="is cut"):
        array_events(message[:-1], cdr=cdr)
