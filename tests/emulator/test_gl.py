from __future__ import annotations

import os
import subprocess
import sys

import numpy as np
import pytest

from emulator.scene.base import SceneError
from emulator.scene.body import Body, BodyParameters
from emulator.scene.checkerboard import Checkerboard, CheckerboardParameters
from emulator.scene.gl import PACKAGES, open_context, probe, renderer_name


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
        Body(BodyParameters(shape="eros007790"), (32, 24))


@pytest.mark.gl
@pytest.mark.usefixtures("gl")
@pytest.mark.parametrize(("variable", "value", "meaning"), MISSING[1:])
def test_the_environment_decides_and_is_blamed(monkeypatch, variable, value, meaning):
    monkeypatch.setenv(variable, value)
    assert meaning in probe().reason


@pytest.mark.parametrize("variable", ["LIBGL_DRIVERS_PATH", "__EGL_VENDOR_LIBRARY_FILENAMES", "GLCONTEXT_LINUX_LIBEGL"])
def test_a_broken_driver_is_reported_once_and_not_on_stderr(variable):
    program = "from emulator.scene.gl import probe; r = probe(); assert not r.available and 'apt install' in r.reason"
    blind = os.environ | {variable: "/none"}
    done = subprocess.run([sys.executable, "-c", program], env=blind, capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")


def test_closed_forms_need_no_gl(monkeypatch):
    monkeypatch.setitem(sys.modules, "moderngl", None)  # importing it would raise
    out = np.zeros((24, 32), np.float32)
    with Checkerboard(CheckerboardParameters(), (32, 24)) as board:
        board.light(0, out)
    assert out.any()


def test_scenes_can_be_imported_without_loading_gl_or_trimesh():
    program = (
        "import sys, emulator.scene.body, emulator.scene.checkerboard, emulator.scene.picture\n"
        "assert not {'moderngl', 'glcontext', 'trimesh', 'PIL'} & set(sys.modules)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, timeout=60)
    assert (done.returncode, done.stderr) == (0, "")
