"""Settings of Python that hold from the start of a command until a run begins."""

import gc

import pytest

RIG = """
[scene]
kind = "checkerboard"
square_px = 20.0
speed_px_s = 60.0
[camera]
model = "davis346"
[run]
pace = "free"
seconds = 0.02
[[links]]
kind = "loopback"
"""


@pytest.mark.system
def test_a_run_collects_garbage_as_often_as_python_usually_does(evstim, tmp_path):
    rig = tmp_path / "small.toml"
    rig.write_text(RIG)
    usual = gc.get_threshold()
    gc.set_threshold(100_000)
    try:
        assert evstim("run", rig, "--json").code == 0
        assert gc.get_threshold() == usual
    finally:
        gc.set_threshold(*usual)
