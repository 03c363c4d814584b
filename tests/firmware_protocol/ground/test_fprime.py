"""The F Prime dictionary: its members lie as our octets do, and fprime-gds decodes and encodes by it."""

import json
import struct
import subprocess
import sys
from pathlib import Path

import pytest
from ground_packets import COMMANDS, SAMPLES

from firmware_protocol.ground.description import instrument_packets
from firmware_protocol.ground.fprime import fprime_text

sys.path.insert(0, str(Path(__file__).parent))

from own_environments import python_with

TEXT = fprime_text(instrument_packets())
BODIES = {
    one.name: one.octets[20 : len(one.octets) - 2 - len(one.rest)]
    for one in SAMPLES
    if one.name not in ("EVENTS", "EDGES", "PONG")
}
CODES = {"U8": "B", "U16": "H", "I16": "h", "U32": "I", "U64": "Q"}


def wanted(name):
    """Return the values of a sample as F Prime shows them: numbers of the wire, octets in arrays."""
    (sample,) = (one for one in SAMPLES if one.name == name)
    raw = {"temperature": -1234, "now_fraction": [128, 0, 0]}
    return {key: raw.get(key, value) for key, value in sample.values.items()}


def test_the_members_of_each_packet_lie_as_our_octets_do():
    dictionary = json.loads(TEXT)
    types = {one["qualifiedName"]: one for one in dictionary["typeDefinitions"]}
    channels = {one["name"]: one for one in dictionary["telemetryChannels"]}
    assert len({one["id"] for one in channels.values()}) == len(channels)
    (packets,) = dictionary["telemetryPacketSets"]
    assert {one["name"] for one in packets["members"]} == set(BODIES)
    for packet in packets["members"]:
        octets, values = BODIES[packet["name"]], {}
        for name in packet["members"]:
            type_ = channels[name]["type"]
            known = types.get(type_["name"], {"kind": "integer"})
            code = CODES.get(type_["name"]) or CODES.get(known.get("representationType", {}).get("name"))
            if known["kind"] == "array":
                values[name.split(".")[-1]], octets = list(octets[: known["size"]]), octets[known["size"] :]
                continue
            (value,), octets = struct.unpack_from(f">{code}", octets), octets[struct.calcsize(code) :]
            labels = {one["value"]: one["name"] for one in known.get("enumeratedConstants", ())}
            values[name.split(".")[-1]] = labels.get(value, value)
        assert octets == b""
        assert values == wanted(packet["name"])


def arguments_of(sample):
    """Return the arguments of a telecommand as the GDS takes them."""
    raw = {"now_fraction": "[64, 0, 0]"}
    return [raw.get(key, value) for key, value in sample.values.items() if not key.startswith("structure")]


@pytest.mark.long
@pytest.mark.anew
@pytest.mark.timeout(900)
def test_fprime_gds_decodes_the_packets_and_encodes_the_arguments(tmp_path):
    python = python_with("fprime-gds", "EVSTIM_FPRIME_PYTHON", tmp_path / "fprime")
    path = tmp_path / "EvstimTopologyDictionary.json"
    path.write_text(TEXT)
    commands = [(one.name, arguments_of(one)) for one in COMMANDS]
    asked = json.dumps({"telemetry": [(name, body.hex()) for name, body in BODIES.items()], "commands": commands})
    reader = Path(__file__).with_name("fprime_reader.py")
    command = [python, reader, path]
    done = subprocess.run(command, input=asked, capture_output=True, text=True, timeout=120, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    told = json.loads(done.stdout.split("RESULT ", 1)[1])
    for name, values in zip(BODIES, told["telemetry"], strict=True):
        assert values == wanted(name)
    for sample, (opcode, data) in zip(COMMANDS, told["commands"], strict=True):
        assert opcode == int.from_bytes(sample.octets[7:9], "big")
        body = b"" if sample.name == "RequestHousekeeping" else sample.octets[11:-2]
        assert bytes.fromhex(data) == body
