"""Requests, privilege, heartbeat and registers: what drivers rely on, and what hostile datagrams must not do."""

import struct
import zipfile
from collections import Counter
from io import BytesIO
from xml.etree import ElementTree

import numpy as np
import pytest
from gige_host import PEER, STRANGER, Host

from firmware_protocol.gige.gvcp import Command, Status, request
from firmware_protocol.gige.registers import Register
from firmware_protocol.imx636.triton2_registers import ACQUISITION_START, ACQUISITION_STOP, BIASES, TEMPERATURE

SECOND_NS = 1_000_000_000


def test_discovery_is_the_first_248_octets():
    host = Host(serial="123", user_name="left")
    status, payload = host.send(Command.DISCOVERY)
    assert (status, len(payload)) == (0, 248)
    assert payload[0x24:0x28] == bytes([127, 0, 0, 1])
    texts = [payload[at : at + 16].rstrip(b"\0") for at in (0x48, 0x68, 0xD8, 0xE8)]
    assert texts == [b"Lucid Vision Lab", b"TRT009S-E", b"123", b"left"]


def test_golden_octets_of_a_register_write():
    host = Host()
    asked = bytes.fromhex("42 01 0082 0008 0007 00000a00 00000002".replace(" ", ""))
    ((answer, peer),) = host.receive([(asked, PEER)])
    assert (answer.hex(" ", 2), peer) == ("0000 0083 0004 0007 0000 0001", PEER)


def test_only_the_owner_writes_and_anyone_reads():
    host = Host()
    assert host.write(Register.HEARTBEAT_MS, 1) == Status.ACCESS_DENIED
    assert host.write(Register.PRIVILEGE, 2) == Status.SUCCESS
    assert host.write(Register.PRIVILEGE, 2, STRANGER) == Status.ACCESS_DENIED
    assert host.write(Register.HEARTBEAT_MS, 1, STRANGER) == Status.ACCESS_DENIED
    assert host.read(Register.PRIVILEGE, STRANGER) == 2
    assert host.write(Register.PRIVILEGE, 0) == Status.SUCCESS
    assert host.write(Register.PRIVILEGE, 2, STRANGER) == Status.SUCCESS


def test_exclusive_control_keeps_readers_out():
    host = Host()
    host.write(Register.PRIVILEGE, 3)
    assert host.send(Command.READREG, struct.pack(">I", 0), STRANGER)[0] == Status.ACCESS_DENIED
    assert host.read(0) == 2 << 16
    assert host.send(Command.DISCOVERY, b"", STRANGER)[0] == Status.SUCCESS


@pytest.mark.parametrize(("silence_s", "kept"), [(5.9, True), (6.1, False)])
def test_control_ends_with_the_heartbeat(silence_s, kept):
    host = Host()
    host.start()
    host.write(Register.HEARTBEAT_MS, 6000)
    host.now_ns = round(silence_s * SECOND_NS)
    host.receive([])
    assert (host.camera.owner is not None) == kept
    assert host.camera.streaming == kept


def test_any_request_of_the_owner_renews_the_heartbeat_and_no_other_does():
    host = Host()
    host.start()
    for seconds in (2, 4, 6):
        host.now_ns = seconds * SECOND_NS
        host.read(Register.PRIVILEGE)
    assert host.camera.streaming
    for seconds in (8, 10):
        host.now_ns = seconds * SECOND_NS
        host.read(Register.PRIVILEGE, STRANGER)
    assert not host.camera.streaming


def test_control_without_heartbeat_lasts():
    host = Host()
    host.start()
    host.write(Register.GVCP_CONFIGURATION, 1)
    host.now_ns = 10**6 * SECOND_NS
    host.receive([])
    assert host.camera.streaming


def test_a_retry_with_a_new_id_is_answered_once_and_last():
    host = Host()
    first, second = (request(Command.READREG, number, struct.pack(">I", TEMPERATURE)) for number in (7, 8))
    other = request(Command.DISCOVERY, 9)
    answers = host.receive([(first, PEER), (second, PEER), (other, STRANGER)])
    assert [int.from_bytes(data[6:8], "big") for data, _ in answers] == [8, 9]
    assert [peer for _, peer in answers] == [PEER, STRANGER]


def test_a_write_that_comes_again_is_not_done_again():
    host = Host()
    host.start()
    again = request(Command.WRITEREG, 500, struct.pack(">II", Register.PACKET_SIZE, 1 << 31 | 1400))
    answers = host.receive([(again, PEER)]) + host.receive([(again, PEER)])
    assert answers[0] == answers[1]
    assert host.camera.next_extra() is not None
    assert host.camera.next_extra() is None


@pytest.mark.parametrize(
    ("command", "payload", "status"),
    [
        (Command.READREG, b"", Status.INVALID_PARAMETER),
        (Command.READREG, b"abc", Status.INVALID_PARAMETER),
        (Command.READREG, struct.pack(">I", 0x7000_0000), Status.INVALID_ADDRESS),
        (Command.READREG, struct.pack(">I", 2), Status.BAD_ALIGNMENT),
        (Command.WRITEREG, struct.pack(">I", 0x938), Status.INVALID_PARAMETER),
        (Command.WRITEREG, struct.pack(">II", 0, 1), Status.WRITE_PROTECT),
        (Command.WRITEREG, struct.pack(">II", 0x6000_0000, 1), Status.INVALID_ADDRESS),
        (Command.READMEM, struct.pack(">IHH", 0, 0, 0), Status.INVALID_PARAMETER),
        (Command.READMEM, struct.pack(">IHH", 0, 0, 1024), Status.INVALID_PARAMETER),
        (Command.READMEM, struct.pack(">IHH", 0x0D3C, 0, 8), Status.INVALID_ADDRESS),
        (Command.READMEM, struct.pack(">I", 0), Status.INVALID_PARAMETER),
        (Command.WRITEMEM, b"1234567", Status.INVALID_PARAMETER),
        (Command.PACKETRESEND, b"", Status.INVALID_PARAMETER),
        (Command.FORCEIP, bytes(55), Status.INVALID_PARAMETER),
        (0x7FFE, b"", Status.NOT_IMPLEMENTED),
    ],
)
def test_malformed_requests_get_the_standards_status(command, payload, status):
    host = Host()
    host.write(Register.PRIVILEGE, 2)
    assert host.send(command, payload)[0] == status


def test_a_header_that_lies_about_its_length():
    host = Host()
    ((answer, _),) = host.receive([(bytes.fromhex("4201008000080001"), PEER)])
    assert int.from_bytes(answer[:2], "big") == Status.INVALID_HEADER


@pytest.mark.parametrize("datagram", ["", "42", "4101000200000001", "4201000200000000"])
def test_what_is_no_request_gets_no_answer(datagram):
    assert Host().receive([(bytes.fromhex(datagram), PEER)]) == []


def test_a_write_of_several_registers_stops_at_the_first_refusal():
    host = Host()
    host.write(Register.PRIVILEGE, 2)
    pairs = struct.pack(">6I", Register.HEARTBEAT_MS, 7000, 0, 1, Register.PENDING_MS, 5)
    assert host.send(Command.WRITEREG, pairs) == (Status.WRITE_PROTECT, struct.pack(">HH", 0, 1))
    assert (host.read(Register.HEARTBEAT_MS), host.read(Register.PENDING_MS)) == (7000, 0)


def test_features_are_written_by_memory_too():
    host = Host()
    host.start()
    assert host.send(Command.WRITEMEM, struct.pack(">II", ACQUISITION_START, 1))[0] == 0
    assert host.send(Command.WRITEMEM, struct.pack(">I4s", Register.USER_NAME, b"left"))[0] == 0
    assert host.send(Command.DISCOVERY)[1][0xE8:0xEC] == b"left"


@pytest.mark.parametrize("name", BIASES)
def test_biases_tell_their_bounds_and_refuse_what_is_beyond(name):
    host, bias = Host(), BIASES[name]
    host.write(Register.PRIVILEGE, 2)
    told = [value - (value >> 31 << 32) for value in (host.read(bias.address + 4), host.read(bias.address + 8))]
    assert told == [bias.least, bias.greatest]
    for value in told:
        assert host.write(bias.address, value) == 0
        assert host.camera.biases[name] == value
    assert host.write(bias.address, bias.greatest + 1) == Status.INVALID_PARAMETER
    assert host.write(bias.address, bias.least - 1) == Status.INVALID_PARAMETER


@pytest.mark.parametrize(
    ("size", "status"), [(576, 0), (1400, 0), (9000, 0), (574, 0x8002), (1401, 0x8002), (9002, 0x8002)]
)
def test_packet_sizes(size, status):
    host = Host()
    host.write(Register.PRIVILEGE, 2)
    assert host.write(Register.PACKET_SIZE, size) == status
    assert host.read(Register.PACKET_SIZE) == (size if status == 0 else 1400)


def test_the_test_packet_has_the_size_asked_for_and_the_bit_is_cleared():
    host = Host()
    host.start()
    host.write(Register.PACKET_SIZE, 1 << 31 | 1 << 30 | 4000)
    assert len(host.camera.next_extra().data) == 4000 - 28
    assert host.read(Register.PACKET_SIZE) == 1 << 30 | 4000
    assert not host.camera.may_fragment


def _memory(host, address, count):
    status, data = host.send(Command.READMEM, struct.pack(">IHH", address, 0, count))
    assert (status, data[:4], len(data)) == (0, address.to_bytes(4, "big"), 4 + count)
    return data[4:]


def test_the_description_names_registers_that_are_there():
    host = Host()
    location = _memory(host, 0x200, 512).split(b"\0")[0].decode()
    name, address, length = location.removeprefix("Local:").split(";")
    address, length = int(address, 16), int(length, 16)
    octets = b"".join(_memory(host, address + at, min(512, -(-(length - at) // 4) * 4)) for at in range(0, length, 512))
    with zipfile.ZipFile(BytesIO(octets[:length])) as archive:
        root = ElementTree.fromstring(archive.read(name.replace(".zip", ".xml")))
    space = "{http://www.genicam.org/GenApi/Version_1_1}"
    addresses = [int(node.text, 16) for node in root.iter(f"{space}Address")]
    assert len(addresses) > 25
    for one in addresses:
        host.read(one)
    names = {node.get("Name") for node in root}
    named = {node.text for tag in ("pValue", "pFeature", "pPort") for node in root.iter(f"{space}{tag}")}
    assert named <= names


def test_actions_are_for_the_device_that_is_meant():
    host = Host()
    host.start()
    host.write(Register.ACTION_DEVICE_KEY, 11)
    host.write(Register.ACTION_GROUP, 22)
    host.write(Register.ACTION_GROUP + 4, 0b0110)
    for keys in ((10, 22, 2), (11, 21, 2), (11, 22, 0b1001)):
        assert host.send(Command.ACTION, struct.pack(">III", *keys), STRANGER) is None
    assert host.send(Command.ACTION, struct.pack(">III", 11, 22, 2), STRANGER) == (0, b"")
    assert host.camera.counters.edges.added == 2, "one pulse, which rises and falls"


def _forced(host, mac, address):
    told = host.send(Command.FORCEIP, struct.pack(">2x6s12xI12xI12xI", mac, address, 0xFF000000, 0), STRANGER)
    return None if told is None else told[0]


def test_another_address_is_refused_by_the_device_that_is_meant_alone():
    host = Host()
    mac = host.send(Command.DISCOVERY)[1][10:16]
    assert _forced(host, b"\1\2\3\4\5\6", 0x0A000001) is None
    assert _forced(host, mac, 0x0A000001) == Status.NOT_IMPLEMENTED
    assert _forced(host, mac, 0x7F000001) == Status.SUCCESS
    host.write(Register.PRIVILEGE, 2)
    assert _forced(host, mac, 0x7F000001) == Status.ACCESS_DENIED


def _with_keys(host):
    for address, value in (
        (Register.ACTION_DEVICE_KEY, 11),
        (Register.ACTION_GROUP, 22),
        (Register.ACTION_GROUP + 4, 2),
    ):
        host.write(address, value)


def _scheduled(host, time_ns):
    return host.send(Command.ACTION, struct.pack(">IIIQ", 11, 22, 2, time_ns), STRANGER, flags=0x81)[0]


def test_a_scheduled_action_is_a_pulse_at_its_time():
    host = Host()
    host.start()
    _with_keys(host)
    host.camera.advance(1000)
    for time_ns in (9_000_000, 4_000_000):
        assert _scheduled(host, time_ns) == Status.SUCCESS
    host.camera.advance(3000)
    assert host.camera.counters.edges.added == 0
    host.camera.advance(20_000)
    assert host.collect()[1]["t"].tolist() == [4000, 4100, 9000, 9100]  # a pulse rises and falls pulse_us later


def test_an_action_that_comes_too_late_is_done_at_once_and_says_so():
    host = Host()
    host.start()
    _with_keys(host)
    host.camera.advance(5000)
    assert _scheduled(host, 4_000_000) == Status.ACTION_LATE
    host.camera.advance(9000)
    assert host.collect()[1]["t"].tolist() == [5000, 5100]


def test_scheduled_actions_end_with_the_acquisition_and_have_a_bound():
    host = Host()
    host.start()
    _with_keys(host)
    for k in range(300):
        assert _scheduled(host, 1_000_000 + k) == Status.SUCCESS
    edges = host.camera.counters.edges
    assert (edges.added, edges.dropped_fifo) == (44, 44)
    host.write(ACQUISITION_STOP, 1)
    host.write(ACQUISITION_START, 1)
    host.camera.advance(9000)
    assert host.camera.counters.edges.added == 44


def test_orders_that_nobody_takes_have_a_bound_and_control_can_still_be_given_back():
    host = Host()
    host.start()
    control = host.control
    statuses = Counter()
    for k in range(5000):
        data = request(Command.WRITEREG, 1 + k % 3, struct.pack(">II", Register.HEARTBEAT_MS, 6000))
        statuses[int.from_bytes(control.receive([(data, PEER)], 0)[0][0][:2], "big")] += 1
    assert statuses == {Status.SUCCESS: 4096, Status.BUSY: 904}
    control.receive([(request(Command.WRITEREG, 9, struct.pack(">II", Register.PRIVILEGE, 0)), PEER)], 0)
    assert (control.owner, len(control.orders)) == (None, 4097)


def test_hosts_without_control_get_so_many_answers_a_second():
    host = Host()
    host.now_ns = 10 * SECOND_NS
    host.write(Register.PRIVILEGE, 2)
    host.now_ns += SECOND_NS
    flood = [(request(Command.DISCOVERY, 1), ("127.0.0.1", 40_001 + k % 2)) for k in range(10_001)]
    assert len(host.receive(flood)) == 2000
    assert host.read(Register.PRIVILEGE) == 2
    host.now_ns += SECOND_NS // 2
    assert len(host.receive(flood)) == 1000


def test_hostile_datagrams_leave_the_camera_at_work():
    draw = np.random.default_rng(7)
    host = Host()
    host.write(Register.PRIVILEGE, 2)
    commands = [*Command, 0, 0xFFFF, 0xC0]
    for k in range(20_000):
        host.now_ns += 1_000_000
        host.write(Register.HEARTBEAT_MS, 1000)
        data = draw.bytes(int(draw.integers(0, 60)))
        if k % 2:
            data = request(int(draw.choice(commands)), int(draw.integers(1, 9)), data, int(draw.integers(0, 256)))
        for answer, _ in host.receive([(data, STRANGER if k % 3 else ("10.0.0.1", k % 7))]):
            assert len(answer) <= 8 + 540
    assert host.camera.owner == PEER
    assert host.read(Register.PRIVILEGE) == 2
