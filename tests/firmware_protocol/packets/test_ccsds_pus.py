"""Space packets and PUS-C packets, with the spacepackets library as the oracle."""

from binascii import crc_hqx

import pytest
from hypothesis import given
from hypothesis import strategies as st
from spacepackets.ccsds import PacketType as OracleType
from spacepackets.ccsds import SequenceFlags as OracleFlags
from spacepackets.ccsds import SpacePacketHeader
from spacepackets.ecss.tc import PusTc
from spacepackets.ecss.tm import MiscParams, PusTm

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import (
    OWN_EPOCH_4_3,
    TC_OVERHEAD,
    TM_OVERHEAD,
    Acknowledge,
    PacketType,
    SequenceFlags,
    SpacePacket,
    TcPacket,
    TmPacket,
)

APIDS = st.integers(0, 0x7FF)
COUNTS = st.integers(0, 0x3FFF)
BYTES = st.integers(0, 0xFF)
U16 = st.integers(0, 0xFFFF)
TIMES_US = st.integers(0, 2**32 * 1_000_000 - 1)

SPACE_PACKETS = st.builds(
    SpacePacket,
    st.sampled_from(PacketType),
    APIDS,
    COUNTS,
    st.binary(min_size=1, max_size=300),
    st.booleans(),
    st.sampled_from(SequenceFlags),
)
TM_PACKETS = st.builds(
    TmPacket, APIDS, COUNTS, BYTES, BYTES, TIMES_US, st.binary(max_size=300), U16, U16, st.integers(0, 15)
)
TC_PACKETS = st.builds(
    TcPacket, APIDS, COUNTS, BYTES, BYTES, st.binary(max_size=300), st.integers(0, 15).map(Acknowledge), U16
)


@given(SPACE_PACKETS)
def test_space_packets_round_trip_and_agree_with_spacepackets(packet):
    octets = bytes(packet)
    assert SpacePacket.parse(octets) == packet
    oracle = SpacePacketHeader.unpack(octets)
    assert oracle.apid == packet.apid
    assert oracle.seq_count == packet.sequence_count
    assert oracle.packet_type == OracleType(packet.type)
    assert oracle.sec_header_flag == packet.secondary_header
    assert oracle.seq_flags == OracleFlags(packet.sequence_flags)
    assert oracle.packet_len == len(octets)


@pytest.mark.parametrize(
    ("apid", "count", "length", "wrong"), [(0x800, 0, 1, "APID"), (1, 0x4000, 1, "count"), (1, 0, 0, "octets")]
)
def test_space_packets_out_of_range_are_refused(apid, count, length, wrong):
    with pytest.raises(ValueError, match=wrong):
        SpacePacket(PacketType.TELEMETRY, apid, count, bytes(length))


def test_the_longest_space_packet():
    packet = SpacePacket(PacketType.TELEMETRY, 1, 0, bytes(65536))
    assert bytes(packet)[4:6] == b"\xff\xff"
    assert SpacePacket.parse(bytes(packet)) == packet
    with pytest.raises(ValueError, match="octets"):
        SpacePacket(PacketType.TELEMETRY, 1, 0, bytes(65537))


@pytest.mark.parametrize(
    ("octets", "reason"),
    [
        ("", "short"),
        ("08 01 c0 00 00 00", "short"),
        ("28 01 c0 00 00 00 00", "version"),
        ("08 01 c0 00 00 01 00", "length"),
        ("08 01 c0 00 00 00 00 00", "length"),
    ],
)
def test_malformed_space_packets_are_refused(octets, reason):
    with pytest.raises(PacketError, match=reason):
        SpacePacket.parse(bytes.fromhex(octets))


@given(TM_PACKETS)
def test_telemetry_is_what_spacepackets_writes(packet):
    oracle = PusTm(
        service=packet.service,
        message_subtype=packet.subtype,
        timestamp=OWN_EPOCH_4_3.encode_us(packet.t_us),
        source_data=packet.data,
        seq_count=packet.sequence_count,
        apid=packet.apid,
        message_counter=packet.type_count,
        destination_id=packet.destination,
        misc_params=MiscParams(spacecraft_time_ref=packet.time_status),
    )
    octets = bytes(packet)
    assert octets == bytes(oracle.pack())
    assert TmPacket.parse(octets) == packet
    assert len(octets) == TM_OVERHEAD + len(packet.data)


@given(TC_PACKETS)
def test_telecommands_are_what_spacepackets_writes(packet):
    oracle = PusTc(
        service=packet.service,
        message_subtype=packet.subtype,
        apid=packet.apid,
        app_data=packet.data,
        seq_count=packet.sequence_count,
        source_id=packet.source,
        ack_flags=int(packet.acknowledge),
    )
    octets = bytes(packet)
    assert octets == bytes(oracle.pack())
    assert TcPacket.parse(octets) == packet
    assert len(octets) == TC_OVERHEAD + len(packet.data)


@given(TM_PACKETS, st.integers(0, 10_000), st.integers(0, 7))
def test_no_single_flipped_bit_passes(packet, at, bit):
    octets = bytearray(bytes(packet))
    octets[at % len(octets)] ^= 1 << bit
    with pytest.raises(PacketError):
        TmPacket.parse(bytes(octets))


@given(st.binary(max_size=60))
def test_hostile_octets_are_refused_or_sound(octets):
    try:
        packet = TmPacket.parse(octets)
    except PacketError:
        return
    assert bytes(packet) == octets


def _resealed(octets, at, value):
    changed = bytearray(octets[:-2])
    changed[at] = value
    return bytes(changed) + crc_hqx(bytes(changed), 0xFFFF).to_bytes(2, "big")


@pytest.mark.parametrize(
    ("at", "value", "reason"),
    [(0, 0x1A, "type"), (0, 0x02, "secondary header"), (2, 0x40, "segmented"), (6, 0x10, "pus version")],
)
def test_sound_packets_of_another_kind_are_refused_by_reason(at, value, reason):
    octets = bytes(TmPacket(0x2A0, 0, 17, 2, 0, b""))
    with pytest.raises(PacketError, match=reason):
        TmPacket.parse(_resealed(octets, at, value))


def test_a_packet_without_room_for_its_header_is_refused():
    with pytest.raises(PacketError, match="short"):
        TmPacket.parse(bytes(SpacePacket(PacketType.TELEMETRY, 1, 0, bytes(15))))
