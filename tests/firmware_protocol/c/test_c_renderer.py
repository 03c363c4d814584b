"""The client for renderers in C, with evstim's own port on the other side."""

from __future__ import annotations

import re
import shutil
import subprocess
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from firmware_protocol.c import FOLDER
from firmware_protocol.renderer import Camera
from tests.firmware_protocol.c.toolchain import SANITIZED, STRICT, compiler, run
from transports.renderer import RendererEnded, RendererError, RendererServer

DRIVER = Path(__file__).with_name("renderer_driver.c")
PAGE = Path(__file__).parents[3] / "docs/renderers.md"
HOSTED = [flag for flag in STRICT if flag != "-ffreestanding"]
CAMERA = Camera((7, 5), 300.0, 10_000_000, slots=2, slot_octets=0)
LONG_S = 20.0


@pytest.fixture(scope="module")
def driver(tmp_path_factory):
    program = tmp_path_factory.mktemp("renderer") / "driver"
    run(compiler("gcc"), *HOSTED, *SANITIZED, "-I", FOLDER, DRIVER, "-o", program)
    return program


@contextmanager
def drawing(driver, *, shared=False, levels=0, count=-1, reason="", camera=CAMERA):
    """The connection, and the driver's process at its other end, which ends after the block."""
    server = RendererServer("127.0.0.1", 0)
    arguments = [driver, server.address[1], int(shared), levels, count, reason]
    with subprocess.Popen([str(a) for a in arguments], stdout=subprocess.PIPE, text=True) as process:
        connection = server.accept(camera, LONG_S)
        assert connection is not None, server.refusals
        try:
            yield connection, process
        finally:
            connection.close()
            process.communicate(timeout=LONG_S)
    assert process.returncode == 0  # the sanitizers found nothing


def printed(process):
    return process.communicate(timeout=LONG_S)[0]


@pytest.mark.parametrize(("levels", "dtype"), [(0, np.float32), (1, np.uint8)])
@pytest.mark.parametrize("shared", [False, True])
def test_images_come_as_the_program_draws_them(driver, shared, levels, dtype):
    with drawing(driver, shared=shared, levels=levels) as (connection, process):
        assert (connection.hello.name, connection.hello.shared) == ("a test in C", shared)
        for t_ms in (10, 20):
            connection.request(t_ms * 1_000_000)
        check_first(connection, 10, dtype)
        connection.request(30_000_000)
        check_first(connection, 20, dtype)
        check_first(connection, 30, dtype)
        connection.close()
        assert printed(process) == "1 "


def check_first(connection, t_ms, dtype):
    """Check the oldest image."""
    drawn = connection.receive(LONG_S)
    assert drawn.head.t_ns == t_ms * 1_000_000
    assert drawn.planes["light"].dtype == dtype
    np.testing.assert_array_equal(drawn.planes["light"], np.full((5, 7), t_ms))
    np.testing.assert_array_equal(drawn.planes["motion"], np.broadcast_to([3, -2], (5, 7, 2)))
    np.testing.assert_array_equal(drawn.planes["rate"], np.full((5, 7), 0.5))


def test_a_pose_and_times_of_the_program_pass(driver):
    camera = Camera((7, 5), 300.0, 0, slots=2, slot_octets=0, has_pose=True)
    with drawing(driver, camera=camera) as (connection, _):
        for _ in range(2):
            connection.request(pose=(1.0, 2.0, 4.5, 1.0, 0.0, 0.0, 0.0))
        images = [connection.receive(LONG_S) for _ in range(2)]
    assert [image.head.t_ns for image in images] == [0, 7_000_000]
    assert images[1].planes["motion"][4, 6].tolist() == [3.0, 4.5]


@pytest.mark.parametrize(("reason", "error"), [("", RendererEnded), ("no such scene", RendererError)])
def test_the_program_ends_with_its_reason(driver, reason, error):
    with drawing(driver, count=0, reason=reason) as (connection, process):
        connection.request(0)
        with pytest.raises(error, match=reason or "scene has ended"):
            connection.receive(LONG_S)
        assert printed(process) == "0 "


def test_the_reason_of_a_refusal_reaches_the_program(driver):
    with drawing(driver) as (connection, process):
        connection.close("light is NaN")
        assert printed(process) == "-1 light is NaN"


def test_a_closed_port_is_an_error_with_a_reason(driver):
    server = RendererServer("127.0.0.1", 0)
    port = server.address[1]
    server.close()
    assert run(driver, port, 0, 0, -1, "").startswith("-2 evstim cannot be reached: ")


def test_it_compiles_as_cpp():
    if shutil.which("g++") is None:
        pytest.skip("no g++: apt-get install g++")
    strict = ["-std=c++11", "-Wall", "-Wextra", "-Werror", "-pedantic"]
    assert run("g++", *strict, "-fsyntax-only", "-I", FOLDER, "-x", "c++", DRIVER) == ""


def test_the_program_of_the_page_compiles(tmp_path):
    (program,) = re.findall(r"```c\n(.*?)```", PAGE.read_text(), re.DOTALL)
    source = tmp_path / "program.c"
    source.write_text(program)
    assert run(compiler("gcc"), *HOSTED, "-fsyntax-only", "-I", FOLDER, source) == ""
