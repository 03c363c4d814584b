"""Frames in whole runs: from the rig's table through a link's process into the record; and none without the table."""

import numpy as np
import pytest

from emulator.rig.loading import RigError, parse_rig
from emulator.sensor.parameters import FrameParameters
from tests.npz_records import load_frames

SCENE = '[scene]\nkind = "checkerboard"\nspeed_px_s = 20.0\n'
SMALL = "[camera.sensor]\nwidth = 64\nheight = 48\n"
RUN = '[run]\nseconds = 0.2\npace = "free"\n'
LINK = '[[links]]\nkind = "loopback"\n'


def rig(text):
    return parse_rig(SCENE + text + LINK, "my.toml", "my")


def test_the_table_is_typed_and_its_mistakes_are_told():
    assert rig("[camera.frames]\nreset_dn = 800\n").camera.frames == FrameParameters(reset_dn=800)
    with pytest.raises(RigError, match="reset_dn must be 384 to 1023, got 100"):
        rig("[camera.frames]\nreset_dn = 100\n")
    with pytest.raises(RigError, match=r"camera\.frames\.kicks\.share"):
        rig("[camera.frames.kicks]\nshare = 2\n")


@pytest.mark.system
@pytest.mark.parametrize("layout", ["upright", "turned"])
def test_a_run_delivers_its_frames_and_records_them(tmp_path, json_of, layout):
    path, record = tmp_path / "my.toml", tmp_path / "a.npz"
    path.write_text(SCENE + f'[camera]\nlayout = "{layout}"\n[camera.frames]\n' + SMALL + RUN + LINK)
    told = json_of(0, "run", path, "--record", record)
    readings = told["links"]["loopback"]["readings"]["frames"]
    assert readings["balanced"]
    assert readings["delivered"] == readings["offered"] == readings["taken"] > 300
    frames, _ = load_frames(record)
    assert len(frames) >= 3
    assert np.ptp(frames["pixels"].astype(int)) > 200
    assert set(frames["exposure_end"] - frames["exposure_begin"]) == {4000}
