"""`evstim run --trace`: which links are traced, into which files, and what is refused before the run."""

import pytest

from emulator.cli.output import Failure
from emulator.cli.run_summary import begin_trace
from emulator.rig.kinds import SCENES
from emulator.rig.loading import Rig
from emulator.rig.tables import Camera
from emulator.run.assembly import link_setups
from transports.usb.kind import LoopbackLink, UsbipLink


def setups(*links):
    return link_setups(Rig("traced", "", SCENES["checkerboard"].parameters(), Camera(), links=links))


def test_without_the_option_nothing_is_traced():
    assert [setup.endpoint.trace for setup in begin_trace(setups(UsbipLink()), None)] == [None]


def test_one_link_has_the_files_asked_for_and_loses_what_they_held(tmp_path):
    (tmp_path / "usb.txt").write_text("old")
    (setup, other) = begin_trace(setups(UsbipLink(), LoopbackLink()), tmp_path / "usb")
    assert setup.endpoint.trace == tmp_path / "usb"
    assert not hasattr(other.endpoint, "trace")
    assert (tmp_path / "usb.txt").read_text() == ""


def test_several_links_have_their_names_in_them(tmp_path):
    links = (UsbipLink(name="left"), UsbipLink(name="right", port=3241))
    paths = [setup.endpoint.trace for setup in begin_trace(setups(*links), tmp_path / "usb")]
    assert paths == [tmp_path / "usb-left", tmp_path / "usb-right"]


def test_a_rig_without_such_a_cable_is_refused(tmp_path):
    with pytest.raises(Failure, match="no link of kind usbip"):
        begin_trace(setups(LoopbackLink()), tmp_path / "usb")


def test_a_folder_that_is_not_there_is_told_before_the_run(tmp_path):
    with pytest.raises(Failure, match="does not exist"):
        begin_trace(setups(UsbipLink()), tmp_path / "nowhere" / "usb")
