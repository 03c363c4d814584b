"""What rigs need of the machine: one declaration, of the kinds of scenes and links."""

import importlib.metadata
import json
import re
import struct
import tomllib
from pathlib import Path

import pytest

from emulator.cli.app import _main
from emulator.gl.context import WANTED
from emulator.rig.loading import load_rig, parse_rig, shipped_rigs
from emulator.run.machine import needs_of
from firmware_protocol.recordings.aedat4 import MAGIC
from tests.transports.recording.samples import sample_events, write
from transports import needs
from transports.recording.format import FORMATS

ROOT = Path(__file__).parents[3]
BOARD = '[scene]\nkind = "checkerboard"\n'
VHCI = "kernel module vhci-hcd"


@pytest.fixture(autouse=True)
def _nothing_wanted(monkeypatch):
    monkeypatch.delenv(WANTED, raising=False)


@pytest.fixture
def no_packages(monkeypatch):
    def version(name):
        raise importlib.metadata.PackageNotFoundError(name)

    monkeypatch.setattr(importlib.metadata, "version", version)


def names(text):
    return [need.name for need in needs_of(parse_rig(text, "r.toml", "r"))]


@pytest.mark.parametrize("name", shipped_rigs())
def test_the_needs_of_each_shipped_rig(name):
    """By the text of the file, which is read here in another way."""
    table = tomllib.loads(shipped_rigs()[name].read_text())
    links = {link["kind"] for link in table["links"]}
    run = [need.name for need in needs_of(load_rig(name)) if need.by == "run"]
    drivers = [need.name for need in needs_of(load_rig(name)) if need.by == "driver"]
    assert run == (["extra ros2 (cyclonedds)"] if "ros2" in links else [])
    assert drivers == ([VHCI] if "usbip" in links else [])


@pytest.mark.parametrize(
    ("text", "needed"),
    [
        (BOARD, []),
        ('[scene]\nkind = "video"\npath = "a.npy"\n', []),
        ('[scene]\nkind = "video"\npath = "a.MP4"\n', ["extra files (av)"]),
        ('[scene]\nkind = "video"\npath = "folder"\n', ["extra report (pillow)"]),
        ('[scene]\nkind = "ros2"\n', ["extra ros2 (cyclonedds)"]),
        ('[scene]\nkind = "terrain"\n', []),
        ('[scene]\nkind = "terrain"\n[scene.ground]\nkind = "heightmap"\npath = "a.tif"\n', ["extra report (pillow)"]),
        ('[scene]\nkind = "recording"\npath = "a.npz"\n', []),
        ('[scene]\nkind = "recording"\npath = "not_there.aedat4"\n', []),
        ('[scene]\nkind = "recording"\npath = "not_there.bag"\n', ["extra files (rosbags)"]),
        (BOARD + '[[links]]\nkind = "usb_gadget"\n', ["kernel module libcomposite and a USB device controller"]),
        (BOARD + '[[links]]\nkind = "can"\n', []),
        (
            BOARD + '[[links]]\nkind = "can"\ninterface = "socketcan"\nchannel = "vcan7"\nchannel_b = "can8"\n',
            ["network interface vcan7", "network interface can8"],
        ),
        (BOARD + '[[links]]\nkind = "tcp"\ncompression = "lz4"\n', ["extra files (lz4)"]),
        (BOARD + '[[links]]\nkind = "file"\npath = "a.aedat4"\n', ["extra files (faery)"]),
        (BOARD + '[[links]]\nkind = "file"\npath = "a.raw"\n', []),
        (BOARD + '[[links]]\nkind = "usbip"\nname = "a"\n[[links]]\nkind = "usbip"\nport = 7\n', [VHCI]),
    ],
)
def test_the_needs_of_each_kind(text, needed):
    assert names(text) == needed


@pytest.mark.parametrize(
    ("name", "needed"),
    [("csv", []), ("dat", []), ("es", []), ("evt3", []), ("aedat2", []), ("npz", []), ("dsec", ["extra files (h5py)"]),
     ("ros1", ["extra files (rosbags)"]), ("ros2-dvs", ["extra files (rosbags)"]), ("aedat4", ["extra files (lz4)"])],
)  # fmt: skip
def test_a_recording_needs_what_reads_it(name, needed, tmp_path):
    """Files by the writers; that of AEDAT 4.0 compresses."""
    form = FORMATS[name]
    write(tmp_path / f"a{form.suffixes[0]}", name, sample_events())
    assert names(f'[scene]\nkind = "recording"\npath = "{tmp_path}/a{form.suffixes[0]}"\n') == needed


@pytest.mark.parametrize("compression", range(5))
def test_aedat4_needs_the_library_of_its_compression(compression, tmp_path):
    xml = b"<dv/>"
    table = struct.pack("<I4s6xHHHHHiiIq4xI", 24, b"IOHE", 10, 24, 4, 12, 8, 10, compression, 16, -1, len(xml)) + xml
    (tmp_path / "a.aedat4").write_bytes(MAGIC + struct.pack("<I", len(table)) + table)
    needed = names(f'[scene]\nkind = "recording"\npath = "{tmp_path}/a.aedat4"\n')
    assert needed == (["extra files (lz4)"] if compression in (1, 2) else [])


def test_each_package_is_in_the_extra_that_brings_it():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["optional-dependencies"]
    for name, of in needs.PYTHON_PACKAGES.items():
        assert name in [re.split(r"[<>=!; ]", requirement)[0] for requirement in extras[of.extra]], name


def test_a_package_that_is_missing_has_its_command(no_packages):
    found = needs.package("cyclonedds").look()
    assert (found.good, found.fix) == (False, "pip install '.[ros2]'  # in the source folder of evstim")


@pytest.mark.parametrize("there", [True, False])
def test_a_network_interface_is_looked_for(tmp_path, monkeypatch, there):
    monkeypatch.setattr(needs, "_NETWORK", tmp_path)
    if there:
        (tmp_path / "can7").mkdir()
    found = needs.network_interface("can7").look()
    assert found.good is there
    assert (found.fix is None) is there


def test_rigs_lists_the_needs_of_each(no_packages, capsys, json_of):
    told = {rig["name"]: rig["needs"] for rig in json_of(0, "rigs")["rigs"]}
    assert set(told) == set(shipped_rigs())
    assert told["loopback"] == []
    fix = "pip install '.[ros2]'  # in the source folder of evstim"
    assert told["stars-ros2"] == [{"name": "extra ros2 (cyclonedds)", "by": "run", "good": False, "fix": fix}]
    assert [(need["name"], need["by"]) for need in told["eros"]] == [(VHCI, "driver")]
    assert _main(["rigs"]) == 0
    assert f"            needs the extra ros2 (cyclonedds): missing; {fix}" in capsys.readouterr().out


def test_doctor_shows_the_needs_of_a_rig_and_measures_none_that_cannot_run(no_packages, capsys, json_of):
    told = json_of(3, "doctor", "stars-ros2")
    assert [need["name"] for need in told["needs"]] == ["extra ros2 (cyclonedds)"]
    assert told["real_time"] is None
    assert _main(["doctor", "stars-ros2"]) == 3
    first, last = capsys.readouterr().out.splitlines()
    assert first.startswith("stars-ros2: needs the extra ros2 (cyclonedds): missing; pip install '.[ros2]'")
    assert "does NOT run on this machine" in last


@pytest.mark.long
def test_what_drivers_need_is_no_reason_not_to_measure(monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(needs, "_VHCI", tmp_path / "none")
    rig = tmp_path / "small.toml"
    small = "[run]\nseconds = 0.01\nstep_us = 5000\n"
    rig.write_text(f'{BOARD}{small}[[links]]\nkind = "usbip"\n')
    assert _main(["doctor", str(rig), "--json"]) in (0, 1)  # fast or slow, but measured
    told = json.loads(capsys.readouterr().out.splitlines()[-1])
    assert told["needs"][0]["good"] is False
    assert told["real_time"] in (True, False)
