"""The painter of bodies and terrain: the CPU on every machine, GL where a rig or the environment selects it."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from emulator.cli.run import run_rig, summary, summary_lines
from emulator.gl import context
from emulator.gl.context import WANTED, open_context, probe, renderer_name
from emulator.rig.loading import RigError, load_rig, parse_rig
from emulator.run.assembly import build_scene
from emulator.run.kernels import parts_of
from transports.usb.kind import LoopbackLink

SIZE = (64, 48)


@pytest.fixture(autouse=True)
def _nothing_wanted(monkeypatch):
    monkeypatch.delenv(WANTED, raising=False)


@pytest.fixture
def card(monkeypatch, gl):
    """Let this machine have a graphics card that works: its device file is there, and its renderer is hardware."""
    exists = Path.exists
    monkeypatch.setattr(Path, "exists", lambda path: str(path) == "/dev/dri" or exists(path))
    monkeypatch.setattr(context, "_SOFTWARE", ())
    assert probe().available
    assert not context.is_software(probe().renderer)
    return gl


def rig_by(painter, name="eros"):
    rig = load_rig(name)
    run = dataclasses.replace(rig.run, painter=painter, pace="free", seconds=0.01)
    return dataclasses.replace(rig, run=run, links=(LoopbackLink(),))


def light_of(rig):
    light = np.zeros(SIZE[::-1], np.float32)
    with build_scene(rig, SIZE) as scene:
        scene.light(1_000_000, light)
        return light, scene.painter, scene.renderer


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.gl
@pytest.mark.parametrize("name", ["eros", "malapert"])
def test_a_graphics_card_changes_neither_the_painter_nor_the_light(request, name):
    without, painter, by = light_of(load_rig(name))
    gl = request.getfixturevalue("card")
    light, painter_there, by_there = light_of(load_rig(name))
    assert by == by_there == "the CPU, exact coverage"
    assert gl.renderer not in by_there
    assert painter == painter_there == "cpu"
    np.testing.assert_array_equal(light, without)


@pytest.mark.system
@pytest.mark.gl
@pytest.mark.parametrize(
    ("of_rig", "of_environment", "painter"),
    [("cpu", "", "cpu"), ("gl", "", "gl"), ("cpu", " GL ", "gl"), ("cpu", "llvmpipe", "gl"), ("gl", "CPU", "cpu")],
)
def test_the_environment_goes_before_the_rig(gl, monkeypatch, of_rig, of_environment, painter):
    if of_environment == "llvmpipe":
        of_environment = gl.renderer.split()[0]
    monkeypatch.setenv(WANTED, of_environment)
    _, drawn, renderer = light_of(rig_by(of_rig))
    assert drawn == painter
    assert (renderer == gl.renderer) == (painter == "gl")


@pytest.mark.gl
@pytest.mark.parametrize("wanted", ["cpu", "gl"])
def test_the_names_of_painters_exclude_no_renderer(gl, monkeypatch, wanted):
    """Pixels on the card have a GL context of their own, also where the CPU draws."""
    monkeypatch.setenv(WANTED, wanted)
    made = open_context()
    assert renderer_name(made) == gl.renderer
    made.release()


@pytest.mark.sampled
@pytest.mark.system
@pytest.mark.gl
@pytest.mark.parametrize("painter", ["cpu", "gl"])
def test_summary_and_json_contain_the_painter(gl, capsys, painter):
    rig = rig_by(painter)
    result = run_rig(rig, show=True)
    lines = [*capsys.readouterr().out.splitlines(), *summary_lines(rig, result)]
    words = "the CPU, exact coverage" if painter == "cpu" else f"GL: {gl.renderer}"
    assert f"drawn by {words}" in lines
    assert summary(rig, result)["painter"] == painter
    assert any(line.startswith("note: GL draws, by points") for line in lines) == (painter == "gl")


def test_a_scene_without_lens_or_gl_is_drawn_by_the_cpu_whatever_the_environment_selects(monkeypatch):
    monkeypatch.setenv(WANTED, "gl")
    assert light_of(load_rig("checkerboard"))[1] == "cpu"


def test_a_rig_cannot_select_a_painter_that_its_scene_does_not_have():
    text = '[scene]\nkind = "checkerboard"\n[run]\npainter = "gl"\n'
    with pytest.raises(RigError, match=r'line 4: run.painter: .*"checkerboard" has no GL.*"bodies" and "terrain"'):
        parse_rig(text, "file.toml", "file")


def test_what_is_compiled_ahead_is_noted_for_each_painter_apart(monkeypatch):
    keys = {parts_of(rig_by(painter))[0].key for painter in ("cpu", "gl")}
    assert keys == {"scene-bodies-by-cpu", "scene-bodies-by-gl"}
    monkeypatch.setenv(WANTED, "cpu")
    assert {parts_of(rig_by(painter))[0].key for painter in ("cpu", "gl")} == {"scene-bodies-by-cpu"}


@pytest.mark.system
@pytest.mark.gl
@pytest.mark.parametrize("name", ["rendezvous", "itokawa"])
def test_gl_draws_the_light_of_the_cpu_s_painter(gl, name):
    """A panel 14 m away, the shadows on it and the Earth 48 000 km behind it; an asteroid with cut facets."""
    exact, light = (light_of(rig_by(painter, name))[0] for painter in ("cpu", "gl"))
    off = np.abs(light - exact) / exact.max()
    assert light.mean() == pytest.approx(exact.mean(), rel=2e-3)
    assert np.quantile(off, 0.95) < 0.01
    assert off.max() < 0.2
