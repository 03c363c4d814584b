"""Gadgets in a folder that behaves as configfs does, as far as they ask it to."""

import errno
from pathlib import Path

import pytest

from firmware_protocol.davis346.device import Davis346Settings
from firmware_protocol.imx636.evk4 import Evk4Settings
from firmware_protocol.usb.descriptors import Speed
from transports.usb.functionfs.gadget import Gadget, GadgetError, Places, controller_of

DAVIS = Davis346Settings(serial="00000042").descriptors()


@pytest.fixture
def places(tmp_path, monkeypatch):
    """A machine with one controller; in configfs a folder is removed with the attributes in it, but no folder is."""

    def rmdir(folder):
        if folder.is_relative_to(tmp_path / "config"):
            default = [folder / name for name in ("strings", "functions", "configs") if (folder / name).is_dir()]
            for path in folder.iterdir():
                if path.is_file() and not path.is_symlink():
                    path.unlink()
            for path in default:
                real_rmdir(path)
        real_rmdir(folder)

    real_rmdir = Path.rmdir
    monkeypatch.setattr(Path, "rmdir", rmdir)
    (tmp_path / "config").mkdir()
    (tmp_path / "udc" / "dummy_udc.0").mkdir(parents=True)
    return Places(tmp_path / "config", tmp_path / "udc", tmp_path / "run")


@pytest.fixture
def new_gadget(places):
    """Make gadgets whose mount is a folder with an ep0."""

    def mount(name, folder, owner):
        (folder / "ep0").touch()

    def make(name="cam"):
        return Gadget(name, places, mount, lambda folder: (folder / "ep0").unlink())

    return make


def tree(folder):
    """Return the files of a gadget with what they hold, and its links."""
    files = [path for path in folder.rglob("*") if path.is_file() and not path.is_symlink()]
    return {str(path.relative_to(folder)): path.read_text() for path in files}


def test_it_holds_what_a_host_is_to_read(new_gadget, places):
    gadget = new_gadget()
    gadget.make(DAVIS)
    assert tree(places.gadgets / "cam") == {
        "idVendor": "0x152a",
        "idProduct": "0x841a",
        "bcdDevice": "0x0206",
        "max_speed": "super-speed",
        "strings/0x409/manufacturer": "iniVation",
        "strings/0x409/product": "DAViS FX3",
        "strings/0x409/serialnumber": "00000042",
        "configs/c.1/MaxPower": "400",
        "configs/c.1/bmAttributes": "0x80",
    }
    link = places.gadgets / "cam" / "configs" / "c.1" / "ffs.cam"
    assert link.resolve() == places.gadgets / "cam" / "functions" / "ffs.cam"
    assert gadget.is_ready
    assert gadget.suits(DAVIS)


def test_a_camera_without_a_serial_string_has_none(new_gadget, places):
    new_gadget().make(Evk4Settings(speed=Speed.HIGH).descriptors())
    strings = places.gadgets / "cam" / "strings" / "0x409"
    assert sorted(path.name for path in strings.iterdir()) == ["manufacturer", "product"]
    assert (places.gadgets / "cam" / "max_speed").read_text() == "high-speed"


def test_it_tells_another_camera_from_its_own(new_gadget):
    gadget = new_gadget()
    gadget.make(DAVIS)
    assert not gadget.suits(Davis346Settings(serial="00000043").descriptors())
    assert not gadget.suits(Davis346Settings(serial="00000042", speed=Speed.HIGH).descriptors())


def test_nothing_stays_when_it_is_removed(new_gadget, places):
    gadget = new_gadget()
    gadget.make(DAVIS)
    gadget.remove()
    assert list(places.gadgets.iterdir()) == []
    assert not gadget.mount.exists()
    gadget.remove()
    assert not gadget.exists


@pytest.mark.parametrize("steps", range(8))
def test_what_a_killed_program_left_is_made_anew(new_gadget, places, steps):
    gadget, folder = new_gadget(), places.gadgets / "cam"
    done = [
        folder.mkdir,
        lambda: (folder / "strings" / "0x409").mkdir(parents=True),
        lambda: (folder / "functions" / "ffs.cam").mkdir(parents=True),
        lambda: (folder / "configs" / "c.1").mkdir(parents=True),
        lambda: (folder / "idVendor").write_text("0x0000"),
        lambda: (folder / "configs" / "c.1" / "ffs.cam").symlink_to(folder / "functions" / "ffs.cam"),
        lambda: gadget.mount.mkdir(parents=True),
        (gadget.mount / "ep0").touch,
    ]
    for step in done[: steps + 1]:
        step()
    gadget.make(DAVIS)
    assert gadget.is_ready
    assert gadget.suits(DAVIS)


def test_one_that_a_program_runs_is_left_alone(new_gadget, places):
    gadget = new_gadget()
    gadget.make(DAVIS)
    gadget.bind("dummy_udc.0")
    for change in (lambda: gadget.make(DAVIS), gadget.remove):
        with pytest.raises(GadgetError, match=r"cam is in use at dummy_udc\.0.*End that one"):
            change()
    gadget.unbind()
    assert gadget.controller == ""
    gadget.remove()


def test_another_programs_gadget_is_left_alone(new_gadget, places):
    (places.gadgets / "cam" / "functions" / "ncm.usb0").mkdir(parents=True)
    with pytest.raises(GadgetError, match=r"the name cam is in use.*ncm\.usb0"):
        new_gadget().make(DAVIS)
    assert (places.gadgets / "cam" / "functions" / "ncm.usb0").is_dir()


def test_a_mount_that_fails_leaves_nothing(places):
    def refuse(name, folder, owner):
        raise GadgetError("mount: no such device")

    with pytest.raises(GadgetError, match="no such device"):
        Gadget("cam", places, refuse).make(DAVIS)
    assert list(places.gadgets.iterdir()) == []


def test_a_controller_that_another_gadget_has_is_told(new_gadget, places, monkeypatch):
    first, second = new_gadget("first"), new_gadget("second")
    first.make(DAVIS)
    second.make(DAVIS)
    first.bind("dummy_udc.0")

    def busy(path, text):
        raise OSError(errno.EBUSY, "Device or resource busy")

    monkeypatch.setattr(Path, "write_text", busy)
    with pytest.raises(GadgetError, match="the gadget first has it"):
        second.bind("dummy_udc.0")


def test_a_machine_without_configfs_is_told_what_to_do(places, new_gadget):
    places.gadgets.rmdir()
    with pytest.raises(GadgetError, match="modprobe libcomposite"):
        new_gadget().make(DAVIS)


def test_a_user_who_is_not_root_is_told_what_to_do(places, new_gadget, monkeypatch):
    monkeypatch.setattr("os.access", lambda path, mode: False)
    with pytest.raises(GadgetError, match=r"only root.*gadget up --user"):
        new_gadget().make(DAVIS)


def test_the_only_controller_needs_no_name(places):
    assert controller_of("", places) == "dummy_udc.0"
    (places.controllers / "fe980000.usb").mkdir()
    assert controller_of("fe980000.usb", places) == "fe980000.usb"
    with pytest.raises(GadgetError, match=r"several.*dummy_udc\.0, fe980000\.usb"):
        controller_of("", places)
    with pytest.raises(GadgetError, match=r"no USB device controller 'other'; there are: dummy_udc\.0"):
        controller_of("other", places)


def test_a_machine_without_a_controller_is_told_of_boards(tmp_path):
    with pytest.raises(GadgetError, match="dtoverlay=dwc2"):
        controller_of("", Places(controllers=tmp_path / "none"))


@pytest.mark.parametrize("name", ["", "a/b", "..", "-x", "a" * 32, "a b"])
def test_a_name_must_do_for_folders(name):
    with pytest.raises(ValueError, match="a gadget's name"):
        Gadget(name)
