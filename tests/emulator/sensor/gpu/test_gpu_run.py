"""A rig's pixels on the graphics card, from its file to the summary."""

import dataclasses

import pytest

from emulator.cli.run import run_rig, summary
from emulator.rig.loading import LoopbackLink, RigError, load_rig, parse_rig
from emulator.run.assembly import build_sensor
from emulator.sensor.gpu.array import GpuArray

pytestmark = pytest.mark.gl

RIG = """
[scene]
kind = "checkerboard"
[camera.sensor]
width = 64
height = 48
leak_hz = 0.1
[camera.sensor.noise]
rms = 0.0
[run]
pixels = "gpu"
pace = "free"
seconds = 0.05
"""


def rig(more=""):
    return parse_rig(RIG + more, "file.toml", "file")


def quiet(more):
    """The rig with tables after its own, which say nothing of noise then."""
    return parse_rig(RIG.replace("[camera.sensor.noise]\nrms = 0.0\n", "") + more, "file.toml", "file")


@pytest.mark.parametrize("more", ["", "tolerance_us = 20\n", 'method = "line"\n'])
def test_a_run_raises_as_many_events_as_on_the_processor(gl, more):
    ours = rig(more)
    theirs = dataclasses.replace(ours, run=dataclasses.replace(ours.run, pixels="cpu"))
    here, there = run_rig(ours), run_rig(theirs)
    assert here.good
    assert there.ledger.raised > 500
    assert here.ledger.raised == pytest.approx(there.ledger.raised, rel=0.005)
    assert (here.pixels_by, there.pixels_by) == (gl.renderer, None)
    assert summary(ours, here)["pixels_by"] == gl.renderer
    assert here.undersampled_share is not None


def test_methods_and_effects_that_are_not_done_there_are_refused():
    with pytest.raises(RigError, match=r'"gpu" has methods "hermite" and "line", got method = \'v2e\''):
        rig('method = "v2e"\n')
    with pytest.raises(RigError, match="at most 250000"):
        rig("step_us = 250001\n")
    for table, meaning in (
        ("[camera.sensor.defects]\nhot_share = 0.5\n", "own pixels"),
        ('[camera.sensor.noise]\nrms = 0.05\ngrade = "grid"\n', "leave it out"),
    ):
        loaded = quiet(table)
        with pytest.raises(RigError, match=f"run.pixels = 'gpu'.*{meaning}"):
            build_sensor(loaded, loaded.camera.sensor)


@pytest.mark.usefixtures("gl")
def test_noise_of_points_and_jitter_go_with_it():
    loaded = quiet("[camera.sensor.noise]\nrms = 0.08\n[camera.sensor.jitter]\nlatency_us = 50\n")
    assert isinstance(build_sensor(loaded, loaded.camera.sensor).pixels, GpuArray)
    assert run_rig(loaded).good


def test_a_run_tells_what_draws(gl, capsys, monkeypatch):
    monkeypatch.setenv("EVSTIM_RENDERER", gl.renderer.split()[0])
    loaded = load_rig("eros")
    run = dataclasses.replace(loaded.run, pace="free", seconds=0.005)
    result = run_rig(dataclasses.replace(loaded, run=run, links=(LoopbackLink(),)), show=True)
    assert capsys.readouterr().out.splitlines()[0] == f"renderer: {gl.renderer}"
    assert summary(loaded, result)["renderer"] == gl.renderer
    assert summary(loaded, result)["pixels_by"] is None
