"""The COSMOS plugin: read by a reader written from COSMOS's documents, and by COSMOS's own code in its environment."""

import binascii
import json
import shlex
import subprocess
import sys
from pathlib import Path

import pytest
from ground_packets import COMMANDS, SAMPLES

from firmware_protocol.ground.cosmos import cosmos_files
from firmware_protocol.ground.description import instrument_packets

sys.path.insert(0, str(Path(__file__).parent))

from own_environments import python_with

FILES = cosmos_files(instrument_packets(), "192.168.1.7", 4000, 5000)
TELEMETRY = FILES["targets/EVSTIM/cmd_tlm/tlm.txt"]


def near(value):
    return pytest.approx(value, rel=1e-12) if isinstance(value, float) else value


def expected(sample):
    return {name.upper(): near(value) for name, value in sample.values.items()}


def packets_of(text):
    """Return the items of each packet: name, first bit, bits, type, id value, states, scale."""
    packets, items, at = {}, [], 0
    for line in text.splitlines():
        words = shlex.split(line)
        match words[0] if words else "":
            case "TELEMETRY":
                items, at = packets.setdefault(words[2], []), 0
            case "APPEND_ITEM" | "APPEND_ID_ITEM":
                id_value = int(words[4]) if "ID" in words[0] else None
                items.append([words[1], at, int(words[2]), words[3], id_value, {}, 1.0])
                at += int(words[2])
            case "ITEM":
                items.append([words[1], int(words[2]), int(words[3]), words[4], None, {}, 1.0])
            case "STATE":
                items[-1][5][int(words[2])] = words[1]
            case "POLY_READ_CONVERSION":
                items[-1][6] = float(words[2])
    return packets


def read(items, octets):
    """Read a packet as COSMOS's documents say: negative offsets and sizes count from the end."""
    bits, values = "".join(f"{octet:08b}" for octet in octets), {}
    for name, at, size, kind, id_value, states, scale in items:
        first = at if at >= 0 else len(bits) + at
        piece = bits[first : first + size if size > 0 else len(bits) + size]
        if kind in ("BLOCK", "STRING"):
            values[name] = int("0" + piece, 2).to_bytes(len(piece) // 8, "big")
            continue
        raw = int(piece, 2) - (1 << size if kind == "INT" and piece[0] == "1" else 0)
        if id_value not in (None, raw):
            return None
        values[name] = states[raw] if states else raw if scale == 1 else raw * scale
    return values


@pytest.mark.parametrize("sample", SAMPLES, ids=lambda one: one.name)
def test_a_packet_is_read_as_it_was_made(sample):
    read_by = {name: read(items, sample.octets) for name, items in packets_of(TELEMETRY).items()}
    (found,) = (name for name, values in read_by.items() if values is not None)
    assert found == sample.name
    values = read_by[found]
    assert {name: values[name] for name in expected(sample)} == expected(sample)
    assert values["ERROR_CONTROL"] == int.from_bytes(sample.octets[-2:], "big")
    blocks = [value for value in values.values() if isinstance(value, bytes)]
    assert blocks == ([sample.rest] if sample.rest else [])


def test_the_plugin_names_the_ports():
    assert "VARIABLE camera_host 192.168.1.7\n" in FILES["plugin.txt"]
    assert "VARIABLE camera_port 4000\n" in FILES["plugin.txt"]
    assert "VARIABLE packet_port 5000\n" in FILES["plugin.txt"]


@pytest.mark.long
@pytest.mark.anew
@pytest.mark.timeout(900)
def test_cosmos_reads_the_packets_and_builds_the_commands(tmp_path):
    python = python_with("openc3", "EVSTIM_OPENC3_PYTHON", tmp_path / "openc3")
    for name, text in FILES.items():
        path = tmp_path / "plugin" / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text)
    commands = [(one.name.upper(), {name.upper(): value for name, value in one.values.items()}) for one in COMMANDS]
    asked = json.dumps({"telemetry": [one.octets.hex() for one in SAMPLES], "commands": commands})
    reader = Path(__file__).with_name("cosmos_reader.py")
    command = [python, reader, tmp_path / "plugin"]
    done = subprocess.run(command, input=asked, capture_output=True, text=True, check=True, timeout=120, cwd=tmp_path)
    assert "overlap" not in done.stdout
    told = json.loads(done.stdout.split("RESULT ", 1)[1].splitlines()[0])
    for sample, came in zip(SAMPLES, told["telemetry"], strict=True):
        assert came["name"] == sample.name
        assert {name: came["values"][name] for name in expected(sample)} == expected(sample)
    assert told["telemetry"][0]["units"]["TEMPERATURE"] == "degC"
    events, failed = told["telemetry"][1]["values"], told["telemetry"][5]["values"]
    assert bytes.fromhex(events["PAYLOAD"]) == SAMPLES[1].rest
    assert failed["FAILURE_TEXT"].encode() == SAMPLES[5].rest
    assert told["good"] == [True] * len(SAMPLES)
    assert told["wrong"] == [False] * len(SAMPLES)
    for sample, octets in zip(COMMANDS, map(bytes.fromhex, told["commands"]), strict=True):
        assert octets[:2] + octets[4:-2] == sample.octets[:2] + sample.octets[4:-2]
        assert int.from_bytes(octets[2:4], "big") == 0xC000
        assert binascii.crc_hqx(octets, 0xFFFF) == 0
