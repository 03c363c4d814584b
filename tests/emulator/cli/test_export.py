"""`evstim export` and `evstim listen udp` as a user meets them."""

import json
from xml.etree import ElementTree as Xml

import pytest

from emulator.cli.app import _main
from firmware_protocol.ground.description import instrument_packets


def test_each_kind_writes_its_files(tmp_path, json_of):
    told = {}
    for kind in ("xtce", "cosmos", "fprime", "wireshark"):
        told[kind] = json_of(0, "export", kind, "--out", tmp_path / "new")["files"]
    packets = instrument_packets()
    root = Xml.parse(told["xtce"][0]).getroot()
    ns = "{http://www.omg.org/spec/XTCE/20180204}"
    assert len(list(root.iter(f"{ns}SequenceContainer"))) == 2 + len([one for one in packets if not one.is_command])
    assert len(list(root.iter(f"{ns}MetaCommand"))) == len([one for one in packets if one.is_command])
    assert [name.rsplit("openc3-cosmos-evstim/", 1)[1] for name in told["cosmos"]] == [
        "plugin.txt",
        "openc3-cosmos-evstim.gemspec",
        "targets/EVSTIM/target.txt",
        "targets/EVSTIM/cmd_tlm/tlm.txt",
        "targets/EVSTIM/cmd_tlm/cmd.txt",
    ]
    with open(told["fprime"][0], encoding="utf-8") as file:
        assert json.load(file)["metadata"]["deploymentName"] == "evstim"


def test_the_ports_and_identifiers_are_those_of_the_rig(tmp_path):
    rig = tmp_path / "my.toml"
    rig.write_text(
        '[scene]\nkind = "checkerboard"\n[[links]]\nkind = "udp_packets"\nport = 5001\ncommand_port = 5002\n'
        '[[links]]\nkind = "can"\ninterface = "virtual"\nchannel = "a"\nnode = 5\n'
    )
    assert _main(["export", "wireshark", str(rig), "--out", str(tmp_path)]) == 0
    assert _main(["export", "cosmos", str(rig), "--out", str(tmp_path)]) == 0
    program = (tmp_path / "evstim.lua").read_text()
    assert "local UDP_PORTS = {5001, 5002}" in program
    assert f'frames[{0x700 + 5}] = {{name = "heartbeat"' in program
    plugin = (tmp_path / "openc3-cosmos-evstim" / "plugin.txt").read_text()
    assert "VARIABLE camera_port 5002\nVARIABLE packet_port 5001\n" in plugin


@pytest.mark.parametrize(
    ("arguments", "code", "told"),
    [
        (["export", "kaitai"], 2, "kaitai"),
        (["export", "xtce", "no-such-rig"], 2, "no-such-rig"),
        (["export", "xtce", "--out", "/proc/none"], 2, "/proc/none"),
        (["listen", "udp", "10015"], 2, "is not HOST:PORT"),
        (["listen", "udp", "127.0.0.1:0"], 2, "is not HOST:PORT"),
        (["listen", "udp", "0.0.0.0:10015"], 2, "set allow, for example"),
        (
            ["listen", "udp", "192.0.2.1:10015", "--allow", "192.0.2.9", "--seconds", "1"],
            3,
            "cannot listen on 192.0.2.1",
        ),
        (["listen", "udp", "127.0.0.1:10015", "--tick", "7"], 2, "tick 7 us"),
    ],
)
def test_mistakes_are_told(arguments, code, told, json_of):
    assert told in json_of(code, *arguments)["error"]
