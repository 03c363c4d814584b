"""Profiles: what one side wraps, the other unwraps; what is lost is counted; hostile bytes hurt nothing."""

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st
from packet_strategies import MESSAGES, TELECOMMANDS, pieces

from firmware_protocol.framing import cobs_frame, kiss_frame, sealed
from firmware_protocol.packets.addresses import Addresses, Message, MessageKind, Received, SequenceFollower
from firmware_protocol.packets.ccsds import APID_IDLE, Acknowledge, PacketType, SpacePacket, TcPacket, TmPacket
from firmware_protocol.packets.codec import CspPacket
from firmware_protocol.packets.profile import PROFILES, Profile
from firmware_protocol.packets.telecommands import FailureCode, Ping, RequestId, SetTick, Stage, Start, Verification

STREAMS = [name for name in PROFILES if name not in ("ccsds", "csp")]
EVENTS = Message(MessageKind.EVENTS, b"a block", 1_500_000)
VERIFICATION = Message(MessageKind.VERIFICATION, Verification(Stage.START, RequestId(0x1AA0, 0xC001)).encode(), 7)


def settled(counters):
    """Whether every byte, frame and packet has exactly one fate."""
    frames = counters.frames
    return (
        frames.bytes_received == frames.bytes_framed + frames.bytes_skipped + frames.pending
        and frames.pending >= 0
        and frames.frames == counters.packets + counters.idle + sum(counters.refused.values())
    )


@pytest.mark.parametrize("name", PROFILES)
@pytest.mark.parametrize("kind", MessageKind)
def test_messages_come_out_as_they_went_in(name, kind):
    profile = Profile(name)
    message = VERIFICATION if kind is MessageKind.VERIFICATION else Message(kind, bytes(range(256)) * 4, 123_456_789)
    assert profile.unwrapper().push(profile.wrap(message)) == [Received(message)]


@pytest.mark.parametrize("name", STREAMS)
@given(messages=st.lists(MESSAGES, max_size=6), cuts=st.lists(st.integers(0, 10_000), max_size=8))
def test_any_messages_in_any_cut(name, messages, cuts):
    profile = Profile(name)
    unwrapper = profile.unwrapper()
    stream = b"".join(map(profile.wrap, messages))
    got = [received for piece in pieces(stream, cuts) for received in unwrapper.push(piece)]
    assert got == [Received(message) for message in messages]
    assert settled(unwrapper.counters)


@pytest.mark.parametrize("name", PROFILES)
@given(commands=st.lists(TELECOMMANDS, max_size=4), acknowledge=st.integers(0, 15).map(Acknowledge))
def test_telecommands_come_out_as_they_went_in(name, commands, acknowledge):
    computer, instrument = Profile(name), Profile(name).command_unwrapper()
    requests = []
    for command in commands:
        (received,) = instrument.push(computer.wrap_command(command, acknowledge))
        assert (received.command, received.acknowledge) == (command, acknowledge)
        assert (received.request, received.failure, received.missing) == (computer.last_request, None, 0)
        requests.append(received.request)
    assert len(set(requests)) == len(commands)


# An event message of seven bytes at 1.5 s, the first of its counter; built by other code: the packet by spacepackets,
# COBS by the cobs package, the CRCs by fastcrc and zlib, CSP by libcsp's csp_kiss_tx. docs/packets.md explains them.
PACKET = "0a a1 c0 00 00 16 20 80 81 00 00 00 00 00 00 00 01 80 00 00 61 20 62 6c 6f 63 6b b7 87"
STUFFED = "04 0a a1 c0 01 05 16 20 80 81 01 01 01 01 01 01 03 01 80 01 0a 61 20 62 6c 6f 63 6b b7 87"
ESCAPED = PACKET.replace("c0", "db dc")
CSP = "01 00 28 92 00 00 00 00 00 00 01 80 00 00 61 20 62 6c 6f 63 6b cb 25 29 02"


@pytest.mark.parametrize(
    ("name", "line"),
    [
        ("ccsds", PACKET),
        ("ccsds-cobs", f"{STUFFED} 00"),
        ("ccsds-slip", f"c0 {ESCAPED} c0"),
        ("ccsds-kiss", f"c0 00 {ESCAPED} 9a c4 e2 3b c0"),
        ("csp-kiss", f"c0 00 db dc {CSP} c0"),
        ("csp", f"c0 {CSP}"),
        ("fprime", f"de ad be ef 00 00 00 1d {PACKET} 47 06 0e a9"),
    ],
)
def test_golden_bytes(name, line):
    assert Profile(name).wrap(EVENTS).hex(" ") == line


@pytest.mark.parametrize("name", PROFILES)
def test_missing_packets_are_counted_under_their_own_counter(name):
    profile = Profile(name)
    unwrapper = profile.unwrapper()
    pong = Message(MessageKind.PONG, b"", 0)
    lines = [profile.wrap(EVENTS if i % 3 else pong) for i in range(30)]
    del lines[7:14]
    received = [r for line in lines for r in unwrapper.push(line)]
    assert [(r.message.kind, r.missing) for r in received if r.missing] == [
        (MessageKind.EVENTS, 5),
        (MessageKind.PONG, 2),
    ]
    assert unwrapper.counters.missing == 7
    assert unwrapper.counters.disordered == 0


@pytest.mark.parametrize("name", PROFILES)
def test_a_repeated_packet_is_taken_and_counted(name):
    profile = Profile(name)
    unwrapper = profile.unwrapper()
    first, second = profile.wrap(EVENTS), profile.wrap(EVENTS)
    assert [len(unwrapper.push(line)) for line in (first, second, second)] == [1, 1, 1]
    assert (unwrapper.counters.missing, unwrapper.counters.disordered) == (0, 1)


def test_counts_are_followed_over_their_end():
    follower = SequenceFollower(16_384)
    assert [follower.follow("apid", n) for n in (16_382, 16_383, 0, 3, 2, 3)] == [0, 0, 0, 2, 0, 0]
    assert (follower.missing, follower.disordered) == (2, 1)
    assert follower.follow("another", 99) == 0


def test_space_packets_for_others_idle_ones_and_unknown_services_are_told_apart():
    unwrapper = Profile("ccsds").unwrapper()
    assert unwrapper.push(bytes(SpacePacket(PacketType.TELEMETRY, APID_IDLE, 0, bytes(20)))) == []
    assert unwrapper.push(bytes(TmPacket(0x111, 0, 17, 2, 0, b""))) == []
    assert unwrapper.push(bytes(TmPacket(0x2A0, 0, 5, 1, 0, b""))) == []
    assert unwrapper.push(bytes(SpacePacket(PacketType.TELEMETRY, 0x2A0, 0, bytes(20)))) == []
    assert unwrapper.counters.idle == 1
    assert dict(unwrapper.counters.refused) == {"apid": 1, "service": 1, "crc": 1}
    assert settled(unwrapper.counters)


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (CspPacket(10, 1, 8, 5, bytes(20)), "port"),
        (CspPacket(11, 1, 8, 9, bytes(20)), "address"),
        (CspPacket(10, 1, 8, 9, bytes(8)), "short"),
    ],
)
def test_csp_packets_for_others_are_refused_by_reason(packet, reason):
    unwrapper = Profile("csp-kiss").unwrapper()
    assert unwrapper.push(kiss_frame(bytes(packet))) == []
    assert dict(unwrapper.counters.refused) == {reason: 1}


@pytest.mark.parametrize(
    ("packet", "reason"),
    [
        (CspPacket(1, 11, 8, 8, bytes(20)), "address"),
        (CspPacket(1, 10, 8, 9, bytes(20)), "port"),
        (CspPacket(1, 10, 8, 8, bytes(6)), "short"),
    ],
)
def test_csp_telecommands_for_others_are_refused_by_reason(packet, reason):
    unwrapper = Profile("csp").command_unwrapper()
    assert unwrapper.push(sealed(bytes(packet))) == []
    assert dict(unwrapper.counters.refused) == {reason: 1}


def test_a_telecommand_of_a_libcsp_built_without_csp_21_is_taken():
    packet = Profile("csp").wrap_command(Ping())[:-4]
    line = packet + sealed(packet[6:])[-4:]
    (received,) = Profile("csp").command_unwrapper().push(line)
    assert received.command == Ping()
    assert Profile("csp").unwrapper().push(line) == []


def test_a_whole_telecommand_that_is_unknown_comes_with_the_failure_to_report():
    unwrapper = Profile("ccsds-cobs").command_unwrapper()
    packet = bytes(TcPacket(0x2A0, 5, 128, 3, b"\x00\x07", Acknowledge.NONE))
    (received,) = unwrapper.push(cobs_frame(packet))
    assert received.command is None
    assert received.failure.code is FailureCode.ILLEGAL_DATA
    assert received.request == RequestId(0x1AA0, 0xC005)
    answer = Verification(Stage.ACCEPTANCE, received.request, received.failure)
    assert answer.encode()[:7] == bytes.fromhex("02 1a a0 c0 05 00 05")


def test_telecommands_for_another_apid_and_telemetry_are_not_taken():
    unwrapper = Profile("ccsds").command_unwrapper()
    assert unwrapper.push(bytes(TcPacket(0x111, 0, 17, 1, b""))) == []
    assert unwrapper.push(Profile("ccsds").wrap(EVENTS)) == []
    assert dict(unwrapper.counters.refused) == {"apid": 1, "type": 1}


def test_missing_telecommands_are_counted():
    computer, unwrapper = Profile(), Profile().command_unwrapper()
    lines = [computer.wrap_command(command) for command in (Start(), Ping(), SetTick(10))]
    unwrapper.push(lines[0])
    (received,) = unwrapper.push(lines[2])
    assert (received.missing, unwrapper.counters.missing) == (1, 1)


@pytest.mark.parametrize("name", PROFILES)
def test_random_bytes_make_no_message_and_all_have_a_fate(name):
    source = random.Random(name)
    profile = Profile(name, max_payload=500)
    messages, commands = profile.unwrapper(), profile.command_unwrapper()
    for _ in range(150):
        data = source.randbytes(source.randrange(1, 2000))
        assert messages.push(data) == []
        assert commands.push(data) == []
    assert settled(messages.counters)
    assert settled(commands.counters)


@pytest.mark.parametrize("name", PROFILES)
def test_payloads_up_to_the_limit_pass_and_longer_ones_are_refused_by_the_sender(name):
    profile = Profile(name, max_payload=300)
    longest = Message(MessageKind.EVENTS, b"\xc0" * 300, 0)
    assert profile.unwrapper().push(profile.wrap(longest)) == [Received(longest)]
    with pytest.raises(ValueError, match="at most 300 bytes"):
        profile.wrap(Message(MessageKind.EVENTS, bytes(301), 0))


def test_a_verification_that_is_none_is_refused_by_the_sender():
    with pytest.raises(ValueError, match="subtype"):
        Profile("ccsds").wrap(Message(MessageKind.VERIFICATION, b"", 0))


def test_an_unknown_profile_is_refused_with_the_names_there_are():
    with pytest.raises(ValueError, match="ccsds-cobs, ccsds-slip"):
        Profile("ccsds-hdlc")


@pytest.mark.parametrize(
    ("wrong", "what"),
    [
        ({"apid": 0x7FF}, "APID"),
        ({"apid": 0}, "APID"),
        ({"apid": 5, "science_apid": 5}, "of their own"),
        ({"csp_node": 16_384}, "CSP address"),
    ],
)
def test_addresses_out_of_range_are_refused(wrong, what):
    with pytest.raises(ValueError, match=what):
        Addresses(**wrong)
