"""Pictures come to memory in the order in which they were begun."""

import numpy as np
import pytest

from emulator.gl.render_target import MOST_PENDING, Rectangle, RenderTarget
from emulator.light import SceneError

pytestmark = [pytest.mark.gl, pytest.mark.usefixtures("gl")]

VERTEX = """
#version 430
uniform float turn;
in vec2 place;
void main() { gl_Position = vec4(mat2(cos(turn), -sin(turn), sin(turn), cos(turn)) * place, 0.0, 1.0); }
"""
FRAGMENT = "#version 430\nout float r;\nvoid main() { r = 1.0 + fract(gl_FragCoord.x * 0.37) + gl_FragCoord.y; }"
SIZE = (33, 21)


class Turning:
    """A triangle that turns, in a picture whose margin it cannot reach."""

    def __init__(self):
        self.stage = RenderTarget(SIZE, 3)
        with self.stage.context as gl:
            self.program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
            corners = np.array([(-0.9, -0.8), (0.1, 0.9), (0.8, -0.3)], np.float32)
            self.array = gl.vertex_array(self.program, [(gl.buffer(corners), "2f", "place")])

    def begin(self, turn):
        def render(gl):
            self.program["turn"] = turn
            self.array.render()

        self.stage.begin(render, region=Rectangle(2, 1, 29, 18))

    def take(self, out=None):
        out = np.full(SIZE[::-1], 9, np.float32) if out is None else out
        self.stage.take(out)
        return out


def test_pictures_begun_ahead_are_those_drawn_one_by_one():
    plain = Turning()
    ahead = Turning()
    turns = np.linspace(0, 2, 2 * MOST_PENDING + 1)
    expected = []
    for turn in turns:
        plain.begin(turn)
        expected.append(plain.take())
    assert len({picture.tobytes() for picture in expected}) == len(turns)
    for turn in turns[:MOST_PENDING]:
        ahead.begin(turn)
    for k, picture in enumerate(expected):
        np.testing.assert_array_equal(ahead.take(), picture)
        if k + MOST_PENDING < len(turns):
            ahead.begin(turns[k + MOST_PENDING])
    assert np.all(expected[0][0] == 0)
    assert expected[0].any()


def test_a_picture_can_go_into_part_of_another():
    turning = Turning()
    turning.begin(0.3)
    whole = turning.take()
    room = np.zeros((SIZE[1], 2 * SIZE[0]), np.float32)
    turning.begin(0.3)
    turning.take(room[:, ::2])
    np.testing.assert_array_equal(room[:, ::2], whole)
    assert not room[:, 1::2].any()


def test_too_many_or_no_pictures_under_way_are_refused():
    turning = Turning()
    with pytest.raises(SceneError, match="draw one before"):
        turning.take()
    for _ in range(MOST_PENDING):
        turning.begin(0.1)
    with pytest.raises(SceneError, match=f"{MOST_PENDING} light frames are pending"):
        turning.begin(0.1)
    turning.take()
    turning.begin(0.2)
