from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.gl import context as gl_module
from emulator.gl.context import PACKAGES, WANTED, open_context, probe, renderer_name, renderers
from emulator.light import MachineLacks, SceneError
from emulator.run.machine import examine
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.trajectory.parameters import FixedPath

EROS = BodiesParameters(camera=FixedPath((0.0, 0.0, -1e5)), bodies=(BodyTable(shape="eros007790", units_m=1000.0),))


@pytest.mark.gl
def test_probe_tells_what_draws(gl):
    assert gl.available
    assert gl.renderer
    assert gl.version.startswith(("4.3", "4.4", "4.5", "4.6"))
    assert not gl.reason


@pytest.mark.gl
@pytest.mark.usefixtures("gl")
def test_a_context_draws():
    context = open_context()
    target = context.framebuffer([context.renderbuffer((3, 2), 1, dtype="f4")])
    target.clear(0.25)
    got = np.frombuffer(target.read(components=1, dtype="f4"), np.float32)
    assert renderer_name(context) == probe().renderer
    context.release()
    np.testing.assert_array_equal(got, np.full(6, 0.25, np.float32))


MISSING = [
    ("GLCONTEXT_LINUX_LIBEGL", "libnone.so", "the library is not installed"),
    ("GLCONTEXT_LINUX_LIBGL", "libnone.so", "the library is not installed"),
    ("GLCONTEXT_DEVICE_INDEX", "14", "look at GLCONTEXT_DEVICE_INDEX"),
]


@pytest.mark.parametrize(("variable", "value", "meaning"), MISSING[:1])
def test_without_gl_the_error_names_the_packages(monkeypatch, variable, value, meaning):
    monkeypatch.setenv(variable, value)
    report = probe()
    assert not report.available
    assert meaning in report.reason
    assert f"apt install {PACKAGES}" in report.reason
    with pytest.raises(SceneError, match="libgl1-mesa-dri"):
        GlBodies(EROS, Pinhole.of_field((32, 24), 25.0))


@pytest.mark.gl
@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize(("variable", "value", "meaning"), MISSING[1:])
def test_the_environment_decides_and_is_blamed(monkeypatch, variable, value, meaning):
    monkeypatch.setenv(variable, value)
    assert meaning in probe().reason


@pytest.mark.sampled
@pytest.mark.parametrize("variable", ["LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_FILENAMES", "GLCONTEXT_LINUX_LIBEGL"])
def test_a_broken_driver_is_reported_once_and_not_on_stderr(variable):
    program = "from emulator.gl.context import probe; r = probe(); assert not r.available and 'apt install' in r.reason"
    blind = os.environ | {variable: "/none"}
    done = subprocess.run([sys.executable, "-c", program], env=blind, capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")


def test_closed_forms_need_no_gl(monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", None)  # importing it would raise
    out = np.zeros((24, 32), np.float32)
    with Checkerboard(CheckerboardParameters(), (32, 24)) as board:
        board.light(0, out)
    assert out.any()


def test_scenes_can_be_imported_without_loading_gl_or_trimesh():
    program = (
        "import sys, emulator.scene.bodies.gl_bodies, emulator.scene.bodies.raster_bodies, emulator.report.pictures\n"
        "assert not {'moderngl', 'glcontext', 'trimesh', 'PIL'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=300)
    assert (done.returncode, done.stderr) == (0, "")


@pytest.mark.gl
def test_the_renderer_can_be_chosen_by_part_of_its_name(gl, monkeypatch):
    monkeypatch.setenv(WANTED, gl.renderer.split()[0].upper())
    assert probe().renderer == gl.renderer


@pytest.mark.gl
def test_a_renderer_that_is_not_there_is_refused_with_those_that_are(gl, monkeypatch):
    monkeypatch.setenv(WANTED, "matrox")
    with pytest.raises(MachineLacks, match=rf"'matrox'.*there is {gl.renderer.split()[0]}"):
        open_context()
    egl = next(finding for finding in examine() if finding.name == "EGL")
    assert (egl.good, egl.fix) == (False, f"unset {WANTED}")


class Device:
    """A context by the name of what draws."""

    def __init__(self, name):
        self.info, self.open = {"GL_RENDERER": name}, True

    def release(self):
        self.open = False


CARDS = ["llvmpipe (LLVM 15)", "NVIDIA A", "NVIDIA B"]


@pytest.mark.parametrize(
    ("wanted", "cards", "taken", "opened"),
    [
        ("", CARDS, "NVIDIA A", 2),
        ("", CARDS[:1] * 2, "llvmpipe (LLVM 15)", 2),
        ("llvm", CARDS[::-1], "llvmpipe (LLVM 15)", 3),
        ("nvidia b", CARDS, "NVIDIA B", 3),
    ],
)
def test_a_graphics_card_goes_before_the_processor_and_a_name_before_both(monkeypatch, wanted, cards, taken, opened):
    monkeypatch.setenv(WANTED, wanted)
    made = _devices(monkeypatch, cards)
    context = open_context()
    assert renderer_name(context) == taken
    assert [device.open for device in made] == [device is context for device in made]
    assert len(made) == opened


def test_doctor_tells_what_else_could_draw(monkeypatch):
    monkeypatch.delenv(WANTED, raising=False)
    made = _devices(monkeypatch, CARDS)
    assert renderers() == tuple(CARDS)
    assert not any(device.open for device in made)
    egl = next(finding for finding in examine() if finding.name == "EGL")
    assert egl.detail.endswith("also there: llvmpipe (LLVM 15), NVIDIA B")


def _devices(monkeypatch, names):
    """Let the machine have devices of these names; returns those that were opened."""
    made = []

    def open_device(index):
        if index >= len(names):
            raise MachineLacks(f"requested device index {index}, but found {len(names)} devices")
        made.append(Device(names[index]))
        made[-1].info["GL_VERSION"] = "4.6"
        return made[-1]

    monkeypatch.delenv("GLCONTEXT_DEVICE_INDEX", raising=False)
    monkeypatch.setattr(gl_module, "_open_device", open_device)
    return made
