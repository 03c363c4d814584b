"""CSP packets, against bytes that libcsp's C code wrote."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.codec import CspPacket, Priority

NODES, PORTS = st.integers(0, 2**14 - 1), st.integers(0, 63)
PACKETS = st.builds(
    CspPacket, NODES, NODES, PORTS, PORTS, st.binary(max_size=50), st.sampled_from(Priority), st.integers(0, 63)
)


# The six bytes behind FEND 00 of what csp_kiss_tx wrote for these fields.
@pytest.mark.parametrize(
    ("packet", "header"),
    [
        (CspPacket(10, 1, 8, 9, b"", Priority.NORMAL), "80 01 00 28 92 00"),
        (CspPacket(8348, 6401, 37, 0, b"", Priority.HIGH, 48), "59 01 82 70 09 70"),
    ],
)
def test_headers_of_libcsp(packet, header):
    assert bytes(packet) == bytes.fromhex(header)
    assert CspPacket.parse(bytes.fromhex(header)) == packet


@given(PACKETS)
def test_packets_round_trip(packet):
    assert CspPacket.parse(bytes(packet)) == packet


def test_what_is_shorter_than_a_header_is_refused():
    with pytest.raises(PacketError, match="short"):
        CspPacket.parse(bytes(5))


def test_addresses_that_the_header_has_no_room_for_are_refused():
    with pytest.raises(ValueError, match=r"source 16384 is not in 0\.\.16383"):
        CspPacket(1 << 14, 1, 0, 0, b"")
