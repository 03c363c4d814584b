"""CRC-32C against published values and the fastcrc library (through spacepackets' own dependency)."""

import fastcrc
import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.framing import crc32c


def test_published_check_value():
    assert crc32c(b"123456789") == 0xE3069283


# RFC 3720, appendix B.4.
@pytest.mark.parametrize(
    ("data", "value"),
    [
        (bytes(32), 0x8A9136AA),
        (b"\xff" * 32, 0x62A8AB43),
        (bytes(range(32)), 0x46DD794E),
        (bytes(range(31, -1, -1)), 0x113FDB5C),
    ],
)
def test_crc32c_of_the_iscsi_standard(data, value):
    assert crc32c(data) == value


@pytest.mark.parametrize("length", [*range(10), 63, 64, 65, 127, 128, 129, 1000])
def test_crc32c_of_every_kind_of_length(length):
    data = bytes(7 * i % 256 for i in range(length))
    assert crc32c(data) == fastcrc.crc32.iscsi(data)


@given(st.binary(max_size=400))
def test_it_agrees_with_an_independent_library(data):
    assert crc32c(data) == fastcrc.crc32.iscsi(data)
