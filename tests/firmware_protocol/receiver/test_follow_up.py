"""The follow-up message of a SYNC."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.can_frames.canopen import ObjectError
from firmware_protocol.can_frames.frame import FollowUp


def test_golden_bytes():
    assert bytes(FollowUp(240, 0x0123456789ABCD)) == bytes.fromhex("f0cdab8967452301")


@given(st.integers(0, 255), st.integers(0, (1 << 56) - 1))
def test_it_comes_back(counter, sent_ns):
    assert FollowUp.parse(bytes(FollowUp(counter, sent_ns))) == FollowUp(counter, sent_ns)


@given(st.binary(max_size=12))
def test_any_bytes_are_a_message_or_refused(data):
    if len(data) == 8:
        assert bytes(FollowUp.parse(data)) == data
    else:
        with pytest.raises(ObjectError, match="8 bytes"):
            FollowUp.parse(data)


@pytest.mark.parametrize(
    ("counter", "sent_ns", "name"), [(256, 0, "counter"), (0, 1 << 56, "sent_ns"), (0, -1, "sent")]
)
def test_what_does_not_fit_is_refused(counter, sent_ns, name):
    with pytest.raises(ValueError, match=name):
        FollowUp(counter, sent_ns)
