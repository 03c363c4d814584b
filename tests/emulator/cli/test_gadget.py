"""`evstim gadget` on a machine that cannot have one: what is said, and the exit codes."""

import pytest

from transports.usb.functionfs import gadget as gadgets
from transports.usb.functionfs.gadget import Places


@pytest.fixture
def machine(tmp_path, monkeypatch):
    """A machine with a controller and without configfs."""
    (tmp_path / "udc" / "dummy_udc.0").mkdir(parents=True)
    places = Places(tmp_path / "config", tmp_path / "udc", tmp_path / "run")
    for module in ("emulator.cli.gadget", "transports.usb.functionfs.gadget"):
        monkeypatch.setattr(f"{module}.Places", lambda: places)
    return places


def test_a_machine_without_configfs_lacks_a_module(machine, json_of):
    said = json_of(3, "gadget", "up")
    assert said["exit_code"] == 3
    assert "modprobe libcomposite" in said["error"]


def test_a_machine_without_a_controller_lacks_that(machine, json_of):
    (machine.controllers / "dummy_udc.0").rmdir()
    assert "no USB device controller" in json_of(3, "gadget", "up")["error"]


@pytest.mark.parametrize(
    ("tokens", "error"),
    [
        (
            ("--model", "triton2"),
            "no USB camera 'triton2'; there are: davis346, davis240c, dvxplorer, dvxplorer_micro, ",
        ),
        (("--model", "evk4", "--serial", "xyz"), "hexadecimal"),
        (("--name", "a/b"), "a gadget's name"),
        (("--user", "nobody-of-this-name"), "no user"),
    ],
)
def test_wrong_use_is_told(machine, json_of, tokens, error):
    assert error in json_of(2, "gadget", "up", *tokens)["error"]


def test_a_gadget_is_made_for_the_camera_and_removed(machine, json_of, monkeypatch):
    made = []
    monkeypatch.setattr(gadgets.Gadget, "make", lambda self, descriptors, owner: made.append((descriptors, owner)))
    json_of(0, "gadget", "up", "--serial", "00000007", "--speed", "high")
    ((descriptors, owner),) = made
    assert descriptors.strings[3] == "00000007"
    assert descriptors.device.speed.name == "HIGH"
    assert owner is None
    assert json_of(0, "gadget", "down") == {"gadget": "evstim", "removed": False}
