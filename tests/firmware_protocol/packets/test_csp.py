"""CSP packets, against bytes that libcsp's C code wrote."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.csp import CspPacket, CspVersion, Priority


def packets(version):
    node = st.integers(0, 2**14 - 1 if version is CspVersion.TWO else 31)
    flags = st.integers(0, 63 if version is CspVersion.TWO else 255)
    port = st.integers(0, 63)
    return st.builds(
        CspPacket, node, node, port, port, st.binary(max_size=50), st.sampled_from(Priority), flags, st.just(version)
    )


PACKETS = st.sampled_from(CspVersion).flatmap(packets)


# The four or six bytes behind FEND 00 of what csp_kiss_tx wrote for these fields.
@pytest.mark.parametrize(
    ("packet", "header"),
    [
        (CspPacket(10, 1, 8, 9, b"", Priority.NORMAL), "80 01 00 28 92 00"),
        (CspPacket(8348, 6401, 37, 0, b"", Priority.HIGH, 48), "59 01 82 70 09 70"),
        (CspPacket(25, 7, 37, 60, b"", Priority.LOW, 81, CspVersion.ONE), "f2 7f 25 51"),
    ],
)
def test_headers_of_libcsp(packet, header):
    assert bytes(packet) == bytes.fromhex(header)
    assert CspPacket.parse(bytes.fromhex(header), packet.version) == packet


@given(PACKETS)
def test_packets_round_trip(packet):
    assert CspPacket.parse(bytes(packet), packet.version) == packet


@pytest.mark.parametrize("version", CspVersion)
def test_what_is_shorter_than_a_header_is_refused(version):
    with pytest.raises(PacketError, match="short"):
        CspPacket.parse(bytes(version.header_octets - 1), version)


def test_addresses_that_the_version_has_no_room_for_are_refused():
    assert CspPacket(32, 1, 0, 0, b"").source == 32
    with pytest.raises(ValueError, match="source has 5 bits"):
        CspPacket(32, 1, 0, 0, b"", version=CspVersion.ONE)
