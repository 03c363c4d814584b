"""CUC times: published values, exactness, limits."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import OWN_EPOCH_4_3, CucFormat


@pytest.mark.parametrize(
    ("format_", "t_us", "octets"),
    [
        (CucFormat(p_field=True), 1_500_000, "2f 00 00 00 01 80 00 00"),
        (OWN_EPOCH_4_3, 1, "00 00 00 00 00 00 11"),
        (OWN_EPOCH_4_3, 123_456_789, "00 00 00 7b 74 f0 20"),
        (OWN_EPOCH_4_3, 999_999, "00 00 00 00 ff ff ef"),
    ],
)
def test_golden_times(format_, t_us, octets):
    assert format_.encode_us(t_us) == bytes.fromhex(octets)
    assert format_.parse_us(bytes.fromhex(octets)) == t_us


@given(st.integers(0, 2**32 * 1_000_000 - 1))
def test_microseconds_come_back_exactly_from_three_octets_of_fraction(t_us):
    assert OWN_EPOCH_4_3.parse_us(OWN_EPOCH_4_3.encode_us(t_us)) == t_us


@pytest.mark.parametrize("t_us", [-1, 2**32 * 1_000_000])
def test_times_that_do_not_fit_are_refused(t_us):
    with pytest.raises(ValueError, match="does not fit"):
        OWN_EPOCH_4_3.encode_us(t_us)


def test_a_wrong_length_or_p_field_is_refused():
    with pytest.raises(PacketError, match="time length"):
        OWN_EPOCH_4_3.parse_us(bytes(8))
    with pytest.raises(PacketError, match="time code"):
        CucFormat(p_field=True).parse_us(bytes.fromhex("2e 00 00 00 01 80 00 00"))
