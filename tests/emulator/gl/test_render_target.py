"""The stage: means over samples, orientation, depth, and what it refuses."""

import numpy as np
import pytest

from emulator.gl.render_target import RenderTarget, depth_terms
from emulator.light import Region, SceneError

pytestmark = pytest.mark.gl

VERTEX = """
#version 430
uniform vec2 depth;
in vec3 place;
in float shine;
flat out float light;
void main() { light = shine; gl_Position = vec4(place.xy * place.z, depth.x * place.z + depth.y, place.z); }
"""
FRAGMENT = "#version 430\nflat in float light;\nout float r;\nvoid main() { r = light; }"


def draw(triangles, size=(8, 6), samples=2, depth=(1.0, 1000.0)):
    """Draw triangles ((x, y) of -1 to 1 with y down, z along the boresight, light), clockwise on the screen."""
    stage = RenderTarget(size, samples)
    out = np.full(size[::-1], 9.0, np.float32)
    with stage.context as gl:
        program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        program["depth"] = depth_terms(*depth)
        data = np.array([[*corner, z, light] for corners, z, light in triangles for corner in corners], np.float32)
        array = gl.vertex_array(program, [(gl.buffer(data), "3f 1f", "place", "shine")])
    stage.draw(lambda _: array.render(), out)
    stage.close()
    return out


# clockwise as GL counts (its rows run upward), so counter-clockwise on the sensor, where rows run down
EVERYWHERE = [(-1, -1), (-1, 3), (3, -1)]
UPPER_LEFT_HALF = [(-1, -1), (-1, 1), (1, -1)]


def test_row_0_is_on_top_and_edges_are_averaged():
    out = draw([(UPPER_LEFT_HALF, 5.0, 1.0)], size=(8, 8), samples=4)
    assert out[0, 0] == 1
    assert out[7, 7] == 0
    assert out[0, 7] == out[7, 0] == pytest.approx(0.5, abs=0.15)


@pytest.mark.parametrize("order", [1, -1])
def test_what_is_nearer_hides_what_is_farther(order):
    assert np.all(draw([(EVERYWHERE, 900.0, 1.0), (EVERYWHERE, 899.0, 2.0)][::order]) == 2.0)


def test_the_far_side_is_not_drawn():
    assert np.all(draw([(EVERYWHERE[::-1], 5.0, 1.0)]) == 0)


def test_outside_its_reach_a_picture_is_black_whatever_was_there_before():
    stage, picture = RenderTarget((8, 6), 2), np.empty((6, 8), np.float32)
    with stage.context as gl:
        program = gl.program(vertex_shader=VERTEX, fragment_shader=FRAGMENT)
        program["depth"] = depth_terms(1.0, 1000.0)
        data = np.array([[*corner, 5.0, 3.0] for corner in EVERYWHERE], np.float32)
        array = gl.vertex_array(program, [(gl.buffer(data), "3f 1f", "place", "shine")])
    for region in [None, Region(1, 5, 2, 5), Region(3, 6, 4, 8)]:
        stage.draw(lambda _: array.render(), picture, region=region)
        top, bottom, left, right = region.bounds if region else (0, 6, 0, 8)
        assert np.all(picture[top:bottom, left:right] == 3)
        assert (picture != 0).sum() == (bottom - top) * (right - left)
    stage.close()


def test_a_picture_too_large_is_refused():
    with pytest.raises(SceneError, match="use fewer samples"):
        RenderTarget((16000, 4), 4)
