"""Pictures come to memory the same bits by either way, in the order in which they were begun."""

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.gl.render_target import READBACK, UNDER_WAY, Rectangle, Stage, strategy_for
from emulator.light import SceneError
from emulator.photometry.reflectance import Sun
from emulator.scene.bodies.gl_bodies import GlBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.trajectory.parameters import FixedPath, SpinPath

pytestmark = [pytest.mark.gl, pytest.mark.usefixtures("gl")]

VERTEX = """
#version 430
uniform float turn;
in vec2 place;
void main() { gl_Position = vec4(mat2(cos(turn), -sin(turn), sin(turn), cos(turn)) * place, 0.0, 1.0); }
"""
FRAGMENT = "#version 430\nout float r;\nvoid main() { r = 1.0 + fract(gl_FragCoord.x * 0.37) + gl_FragCoord.y; }"
SIZE = (33, 21)
TURNING_EROS = BodiesParameters(
    camera=FixedPath((0.0, 0.0, -1e5)),
    sun=Sun((-0.8, -0.2, -0.6)),
    bodies=(BodyTable(shape="eros007790", units_m=1000.0, path=SpinPath(pole=(0.0, -1.0, 0.0), spin_deg_s=90.0)),),
)


class Turning:
    """A triangle that turns, in a picture whose margin it cannot reach."""

    def __init__(self, readback):
        self.stage = Stage(SIZE, 3, readback)
        with self.stage.context as gl:
            self.program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
            corners = np.array([(-0.9, -0.8), (0.1, 0.9), (0.8, -0.3)], np.float32)
            self.array = gl.vertex_array(self.program, [(gl.buffer(corners), "2f", "place")])

    def begin(self, turn):
        def render(gl):
            self.program["turn"] = turn
            self.array.render()

        self.stage.begin(render, reach=Rectangle(2, 1, 29, 18))

    def take(self, out=None):
        out = np.full(SIZE[::-1], 9, np.float32) if out is None else out
        self.stage.take(out)
        return out


@pytest.mark.parametrize("readback", ["direct", "ring"])
def test_pictures_begun_ahead_are_those_drawn_one_by_one(readback):
    plain = Turning("direct")
    ahead = Turning(readback)
    assert ahead.stage.readback == readback
    turns = np.linspace(0, 2, 2 * UNDER_WAY + 1)
    expected = []
    for turn in turns:
        plain.begin(turn)
        expected.append(plain.take())
    assert len({picture.tobytes() for picture in expected}) == len(turns)
    for turn in turns[:UNDER_WAY]:
        ahead.begin(turn)
    for k, picture in enumerate(expected):
        np.testing.assert_array_equal(ahead.take(), picture)
        if k + UNDER_WAY < len(turns):
            ahead.begin(turns[k + UNDER_WAY])
    assert np.all(expected[0][0] == 0)
    assert expected[0].any()


@pytest.mark.parametrize("readback", ["direct", "ring"])
def test_a_picture_can_go_into_part_of_another(readback):
    turning = Turning(readback)
    turning.begin(0.3)
    whole = turning.take()
    room = np.zeros((SIZE[1], 2 * SIZE[0]), np.float32)
    turning.begin(0.3)
    turning.take(room[:, ::2])
    np.testing.assert_array_equal(room[:, ::2], whole)
    assert not room[:, 1::2].any()


@pytest.mark.parametrize("readback", ["direct", "ring"])
def test_too_many_or_no_pictures_under_way_are_refused(readback):
    turning = Turning(readback)
    with pytest.raises(SceneError, match="draw one before"):
        turning.take()
    for _ in range(UNDER_WAY):
        turning.begin(0.1)
    with pytest.raises(SceneError, match=f"{UNDER_WAY} pictures are under way"):
        turning.begin(0.1)
    turning.take()
    turning.begin(0.2)


def test_the_last_picture_stays_in_the_contexts_memory():
    turning = Turning("direct")
    for turn in (0.1, 0.4):
        turning.begin(turn)
    with turning.stage.context:
        held = np.frombuffer(turning.stage.picture.read(), np.float32).reshape(SIZE[::-1])
    turning.take()
    np.testing.assert_array_equal(held, turning.take())
    with turning.stage.context:
        assert turning.stage.picture.read() == held.tobytes()


def test_the_strategy_follows_the_renderer_and_the_environment_overrules(monkeypatch):
    monkeypatch.delenv(READBACK, raising=False)
    assert strategy_for("llvmpipe (LLVM 15.0.6, 256 bits)") == "direct"
    assert strategy_for("NVIDIA RTX A2000/PCIe/SSE2") == "ring"
    monkeypatch.setenv(READBACK, "ring")
    assert strategy_for("llvmpipe") == "ring"
    monkeypatch.setenv(READBACK, "rang")
    with pytest.raises(SceneError, match=f"{READBACK}.*ring"):
        Stage((4, 4), 1)


def test_a_scene_gives_the_same_light_by_either_way(monkeypatch):
    pictures = {}
    for readback in ("direct", "ring"):
        monkeypatch.setenv(READBACK, readback)
        with GlBodies(TURNING_EROS, Pinhole.of_field((48, 36), 25.0)) as body:
            before, after = (np.zeros((36, 48), np.float32) for _ in range(2))
            body.lights((5_000_000, 9_000_000), (before, after))
            assert (before != after).any()
            pictures[readback] = before, after
    np.testing.assert_array_equal(pictures["direct"], pictures["ring"])
