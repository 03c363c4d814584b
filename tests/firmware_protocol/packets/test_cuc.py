"""CUC times: published values, exactness, limits."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import OWN_EPOCH_4_3, CucFormat, Epoch

FORMATS = st.builds(CucFormat, st.sampled_from(Epoch), st.integers(1, 4), st.integers(0, 3), st.booleans())


# The first two as in the tests of the Rust spacepackets library (time/cuc.rs), which has the epoch of 1958 only.
@pytest.mark.parametrize(
    ("format_", "t_us", "octets"),
    [
        (CucFormat(Epoch.TAI_1958, 4, 0, True), 0x20102030 * 1_000_000, "1c 20 10 20 30"),
        (CucFormat(Epoch.TAI_1958, 2, 0, True), 40_000 * 1_000_000, "14 9c 40"),
        (CucFormat(Epoch.TAI_1958, 4, 3, True), 0, "1f 00 00 00 00 00 00 00"),
        (CucFormat(Epoch.OWN, 4, 3, True), 1_500_000, "2f 00 00 00 01 80 00 00"),
        (CucFormat(Epoch.OWN, 4, 2, True), 256_500_000, "2e 00 00 01 00 80 00"),
        (OWN_EPOCH_4_3, 1, "00 00 00 00 00 00 11"),
        (OWN_EPOCH_4_3, 123_456_789, "00 00 00 7b 74 f0 20"),
        (CucFormat(Epoch.TAI_1958), 999_999, "00 00 00 00 ff ff ef"),
    ],
)
def test_golden_times(format_, t_us, octets):
    assert format_.encode_us(t_us) == bytes.fromhex(octets)
    assert format_.parse_us(bytes.fromhex(octets)) == t_us


@given(st.integers(0, 2**32 * 1_000_000 - 1))
def test_microseconds_come_back_exactly_from_three_octets_of_fraction(t_us):
    assert OWN_EPOCH_4_3.parse_us(OWN_EPOCH_4_3.encode_us(t_us)) == t_us


@given(FORMATS, st.integers(0, 255 * 1_000_000))
def test_every_format_is_within_half_a_step(format_, t_us):
    step_us = 1_000_000 / 256**format_.fraction_octets
    try:
        octets = format_.encode_us(t_us)
    except ValueError:
        assert t_us + step_us / 2 >= 256**format_.seconds_octets * 1_000_000
        return
    assert len(octets) == format_.octets
    assert abs(format_.parse_us(octets) - t_us) <= step_us / 2 + 0.5


@pytest.mark.parametrize("t_us", [-1, 2**32 * 1_000_000])
def test_times_that_do_not_fit_are_refused(t_us):
    with pytest.raises(ValueError, match="does not fit"):
        OWN_EPOCH_4_3.encode_us(t_us)


@pytest.mark.parametrize(("seconds", "fraction"), [(0, 3), (5, 3), (4, 4), (4, -1)])
def test_formats_beyond_one_octet_of_p_field_are_refused(seconds, fraction):
    with pytest.raises(ValueError, match="CUC"):
        CucFormat(Epoch.OWN, seconds, fraction)


def test_a_wrong_length_or_p_field_is_refused():
    with pytest.raises(PacketError, match="time length"):
        OWN_EPOCH_4_3.parse_us(bytes(8))
    with pytest.raises(PacketError, match="time code"):
        CucFormat(p_field=True).parse_us(bytes.fromhex("2e 00 00 00 01 80 00 00"))
