"""The neutral description: every packet is there, as long as docs/packets.md tells, and reads what was packed."""

import re
from pathlib import Path

import pytest
from ground_packets import COMMANDS, SAMPLES, T_US

from firmware_protocol.ground.description import instrument_packets
from firmware_protocol.packets.addresses import Addresses
from firmware_protocol.wire_layout import Field, Layout, WrongLength

PACKETS = {one.name: one for one in instrument_packets()}
PAGE = (Path(__file__).parents[3] / "docs" / "packets.md").read_text(encoding="utf-8")


def told(packet, octets):
    """Read a packet bit by bit, by the places of the description alone."""
    bits = "".join(f"{octet:08b}" for octet in octets)
    return {one.field.name: int(bits[one.at : one.at + one.field.bits], 2) for one in packet.fields}


def row_of(name):
    (line,) = re.findall(rf"^\| {name} \|(.*)\|$", PAGE, re.MULTILINE)
    return [cell.strip() for cell in line.split("|")]


def test_every_kind_of_packet_has_a_sample():
    assert {one.name for one in (*SAMPLES, *COMMANDS)} == set(PACKETS)


@pytest.mark.parametrize("sample", [*SAMPLES, *COMMANDS], ids=lambda one: one.name)
def test_places_and_lengths_are_those_of_real_packets(sample):
    packet = PACKETS[sample.name]
    values = told(packet, sample.octets)
    for one in packet.fields:
        assert one.identifies in (None, values[one.field.name]), one.field.name
    assert values["length"] + 7 == len(sample.octets)
    assert packet.before_tail + len(sample.rest) + 2 == len(sample.octets)
    assert packet.lengths[0] <= len(sample.octets) <= packet.lengths[1]
    for name, value in sample.values.items():
        field = next(one.field for one in packet.fields if one.field.name == name)
        raw = values[name] - (values[name] >> field.bits - 1 << field.bits if field.signed else 0)
        assert (field.choices[raw] if field.choices else pytest.approx(raw * field.scale, rel=1e-15)) == value
    assert set(sample.values) == {one.field.name for one in packet.arguments}


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda one: one.name)
def test_the_time_of_a_packet_is_in_its_header(sample):
    values = told(PACKETS[sample.name], sample.octets)
    assert values["time_seconds"] == T_US // 1_000_000
    assert values["time_fraction"] == T_US % 1_000_000 * 2**24 // 1_000_000


@pytest.mark.parametrize("name", [one.name for one in PACKETS.values() if not one.is_command])
def test_messages_are_those_of_the_page(name):
    packet = PACKETS[name]
    apid, types, _, length, _ = row_of(name.split("_")[0])
    assert packet.apid == int(apid, 16)
    numbers = [int(part) for part in re.findall(r"\d+", types)]
    assert packet.service == numbers[0]
    assert packet.subtype in numbers[1:]
    least, greatest = (octets - 22 for octets in packet.lengths)
    lengths = [int(part) for part in re.findall(r"\d+", length.split(";")[0])]
    assert lengths[0] <= least <= greatest <= lengths[-1]


@pytest.mark.parametrize("name", [one.name for one in PACKETS.values() if one.is_command])
def test_telecommands_are_those_of_the_page(name):
    packet = PACKETS[name]
    types, length, _, told_range = row_of(name)
    assert [packet.service, packet.subtype] == [int(part) for part in types.split(",")]
    assert packet.body.octets == int(length)
    if name == "SetTick":
        assert list(packet.body.fields[0].choices) == [int(part) for part in told_range.split(",")]


def test_other_addresses_are_followed():
    packets = instrument_packets(Addresses(apid=0x123, science_apid=0x124))
    assert {(one.apid, one.name in ("EVENTS", "EDGES")) for one in packets} == {(0x123, False), (0x124, True)}


LAYOUT = Layout(
    Field("a", 3, fixed=5), Field("b", 13, signed=True), Field("c", 8, choices={1: "ONE"}), Field("d", 8, highest=9)
)


@pytest.mark.parametrize(("b", "octets"), [(-1, "bfff0109"), (-4096, "b0000109"), (4095, "afff0109")])
def test_a_layout_packs_and_reads_numbers_by_hand(b, octets):
    assert LAYOUT.pack(b=b, c=1, d=9) == bytes.fromhex(octets)
    assert LAYOUT.unpack(bytes.fromhex(octets)) == {"a": 5, "b": b, "c": 1, "d": 9}


@pytest.mark.parametrize("wrong", [{"a": 4}, {"b": 4096}, {"b": -4097}, {"c": 2}, {"d": 10}])
def test_a_layout_refuses_what_does_not_fit(wrong):
    with pytest.raises(ValueError, match=r"is not|is none"):
        LAYOUT.pack(**{"b": 0, "c": 1, "d": 0, **wrong})


def test_a_layout_refuses_unknown_names_wrong_lengths_and_parts_of_octets():
    with pytest.raises(TypeError, match="no field e"):
        LAYOUT.pack(b=0, c=1, d=0, e=0)
    with pytest.raises(TypeError, match="no value for d"):
        LAYOUT.pack(b=0, c=1)
    with pytest.raises(WrongLength):
        LAYOUT.unpack(b"123")
    with pytest.raises(ValueError, match="whole octets"):
        Layout(Field("a", 3))
    with pytest.raises(ValueError, match="twice"):
        Layout(Field("a", 8), Field("a", 8))
