"""XTCE: valid by the schema; space_packet_parser reads our packets with it, and telecommands built from it are ours."""

import binascii
from xml.etree import ElementTree as Xml

import pytest
import space_packet_parser as spp
from ground_packets import COMMANDS, SAMPLES, T_US
from space_packet_parser.exceptions import UnrecognizedPacketTypeError
from space_packet_parser.xtce.validation import validate_xtce

from firmware_protocol.ground.description import instrument_packets
from firmware_protocol.ground.xtce import NAMESPACE, xtce_text

NS = {"x": NAMESPACE}


@pytest.fixture(scope="module")
def document(tmp_path_factory):
    path = tmp_path_factory.mktemp("xtce") / "evstim.xml"
    path.write_text(xtce_text(instrument_packets()), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def definition(document):
    return spp.load_xtce(document)


def test_it_is_valid_by_the_schema_of_the_standard(document):
    result = validate_xtce(document)
    assert result.valid, str(result)


def near(value):
    """A calibrated number is near, all else is equal."""
    return pytest.approx(value, rel=1e-15) if isinstance(value, float) else value


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda one: one.name)
def test_a_packet_is_read_as_it_was_made(definition, sample):
    read = definition.parse_bytes(sample.octets)
    assert read["time_seconds"] + read["time_fraction"] == T_US / 1e6
    assert read["SEQ_FLGS"] == "UNSEGMENTED"
    body = {key.removeprefix(f"{sample.name}_"): value for key, value in read.items() if key.startswith(sample.name)}
    rest = body.popitem()[1] if sample.rest else b""
    assert body == {name: near(value) for name, value in sample.values.items()}
    assert (rest.encode() if isinstance(rest, str) else rest) == sample.rest
    assert read["error_control"] == binascii.crc_hqx(sample.octets[:-2], 0xFFFF)


def test_another_application_is_not_ours(definition):
    other = bytes([0x0A, 0xB0]) + SAMPLES[0].octets[2:]
    with pytest.raises(UnrecognizedPacketTypeError):
        definition.parse_bytes(other)


def built(root, name, values):
    """Build a telecommand as a ground system does: by the definition, then count, length and checksum."""
    command = root.find(f".//x:MetaCommand[@name='{name}']", NS)
    types = {one.get("name"): one for one in root.find(".//x:ArgumentTypeSet", NS)}
    arguments = {one.get("name"): types[one.get("argumentTypeRef")] for one in command.findall(".//x:Argument", NS)}
    bits = ""
    for entry in command.find(".//x:EntryList", NS):
        if entry.tag.endswith("FixedValueEntry"):
            width = int(entry.get("sizeInBits"))
            bits += f"{int(entry.get('binaryValue'), 16):0{width}b}"
        else:
            bits += encoded(arguments[entry.get("argumentRef")], values[entry.get("argumentRef")])
    octets = int(bits, 2).to_bytes(len(bits) // 8, "big")
    octets = octets[:4] + (len(octets) - 7).to_bytes(2, "big") + octets[6:-2]
    return octets + binascii.crc_hqx(octets, 0xFFFF).to_bytes(2, "big")


def encoded(type_, value):
    width = int(type_.find("x:IntegerDataEncoding", NS).get("sizeInBits"))
    labels = {one.get("label"): int(one.get("value")) for one in type_.findall(".//x:Enumeration", NS)}
    scale = [float(one.get("coefficient")) for one in type_.findall(".//x:Term", NS)] or [0, 1]
    raw = labels[value] if labels else round((value - scale[0]) / scale[1])
    valid = type_.find(".//x:ValidRange", NS)
    assert valid is None or int(valid.get("minInclusive")) <= raw <= int(valid.get("maxInclusive"))
    return f"{raw:0{width}b}"


@pytest.mark.parametrize("sample", COMMANDS, ids=lambda one: one.name)
def test_a_telecommand_built_from_it_is_ours_but_for_count_and_acknowledgements(document, sample):
    root = Xml.parse(document).getroot()
    octets = built(root, sample.name, sample.values)
    assert octets[:2] + octets[4:-2] == sample.octets[:2] + sample.octets[4:-2]
    assert octets[2] >> 6 == 3
