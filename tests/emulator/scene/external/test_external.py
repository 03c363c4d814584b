"""The scene of an external renderer, with the client library in a thread: times, pushed images, and bad ones."""

import math
import socket
import threading
from contextlib import contextmanager, suppress

import numpy as np
import pytest

from emulator.geometry.camera import Pinhole
from emulator.light import SceneEnded, SceneError
from emulator.scene.external.external import open_external
from emulator.scene.external.table import ExternalParameters
from emulator.trajectory.parameters import FixedPath, LivePath
from evstim.renderer import Images, Renderer, RendererRefused
from tests.free_ports import free_port

pytestmark = pytest.mark.socket

_PLAIN = Images()
PINHOLE = Pinhole(6, 4, 100.0)
LONG_S = 60.0


class Drawing:
    """A renderer in a thread: image k has the light of `light(t_s, k)`, and `change(image, k)` spoils it.

    Attributes
    ----------
    times : of the requests, ms.
    """

    def __init__(self, port, light, images=_PLAIN, times_ms=None, change=None):
        self.times, self.poses = [], []
        self._work = port, light, images, times_ms, change
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self):
        port, light, images, times_ms, change = self._work
        address = f"127.0.0.1:{port}"
        with suppress(RendererRefused, OSError, ValueError), Renderer(address, images, name="test") as renderer:
            for k, image in enumerate(renderer):
                if times_ms is not None and k == len(times_ms):
                    renderer.end()
                    return
                t_ns = image.t_ns if image.t_ns is not None else round(times_ms[k] * 1e6)
                self.times.append(t_ns / 1e6)
                self.poses.append(image.pose)
                image.light[:] = light(t_ns * 1e-9, k)
                for plane in (image.motion, image.depth, image.rate):
                    if plane is not None:
                        plane[:] = 0
                if change:
                    change(image, k)
                image.send(t_ns=None if image.t_ns is not None else t_ns)

    def join(self):
        self._thread.join(LONG_S)
        assert not self._thread.is_alive()


@contextmanager
def scene_of(light, parameters=None, **drawing):
    port = free_port()
    p = ExternalParameters(port=port, white_w_m2_sr=2.0, timeout_s=LONG_S, wait_s=LONG_S, **(parameters or {}))
    renderer = Drawing(port, light, **drawing)
    scene = open_external(p, PINHOLE)
    try:
        yield scene, renderer
    finally:
        scene.close()
        renderer.join()


def lit(scene, t_ms):
    light, rate = np.zeros((4, 6), np.float32), np.zeros((4, 6), np.float32)
    scene.light_and_rate(round(t_ms * 1e6), light, rate)
    assert (light == light[0, 0]).all()
    return float(light[0, 0]), float(rate[0, 0])


def test_images_are_requested_in_advance():
    with scene_of(lambda t_s, _: t_s, {"ahead": 3}) as (scene, renderer):
        lit(scene, 0)
        lit(scene, 10)
    assert renderer.times[:5] == [0, 10, 20, 30, 40]


def test_a_time_before_starts_again_there():
    with scene_of(lambda t_s, _: t_s, {"ahead": 2}) as (scene, renderer):
        assert lit(scene, 105)[0] == pytest.approx(2 * 0.105)
        assert lit(scene, 31)[0] == pytest.approx(2 * 0.031)
    assert renderer.times[0] == 100
    assert 30 in renderer.times


@pytest.mark.parametrize("value", [math.nan, -1.0, math.inf])
def test_what_a_renderer_writes_after_it_has_sent_an_image_changes_nothing(monkeypatch, value):
    slots = []
    kept = Renderer._planes
    monkeypatch.setattr(Renderer, "_planes", lambda *given: slots.append(kept(*given)) or slots[-1])
    layers = Images(motion=True, depth=True, rate=True)
    with scene_of(lambda t_s, _: 1 + t_s, {"ahead": 0}, images=layers) as (scene, _):
        before = lit(scene, 5)
        for planes in slots:
            for plane in planes.values():
                plane[:] = value
        assert lit(scene, 5) == before


@pytest.mark.parametrize(("levels", "white", "srgb"), [("uint8", 200, False), ("uint16", 1023, True)])
def test_integer_levels_are_light(levels, white, srgb):
    """sRGB by IEC 61966-2-1: half of white is 0.2140 of its light."""
    with scene_of(lambda *_: white // 2, images=Images(levels, white, srgb)) as (scene, _):
        share = white // 2 / white
        expected = ((share + 0.055) / 1.055) ** 2.4 if srgb else share
        assert lit(scene, 3)[0] == pytest.approx(2 * expected, rel=1e-6)


def test_pushed_images_begin_at_the_delay():
    pushed = {"images": "pushed", "delay_ms": 5.0}
    with scene_of(lambda _, k: k, pushed, times_ms=[700, 704, 712]) as (scene, _):
        assert lit(scene, 0)[0] == 0  # before the first one: that one
        assert lit(scene, 5)[0] == 0
        assert lit(scene, 7)[0] == pytest.approx(2 * 0.5)
        assert lit(scene, 15)[0] == pytest.approx(2 * 1.75)
        with pytest.raises(SceneEnded):
            lit(scene, 18)


def test_pushed_images_cannot_go_back():
    with scene_of(lambda _, k: k, {"images": "pushed"}, times_ms=range(0, 5000, 10)) as (scene, _):
        lit(scene, 2000)
        with pytest.raises(SceneError, match="pushed images cannot give"):
            lit(scene, 10)


NANOSECONDS = r"image 1 is 1 ns after the one before.*nanoseconds; does the renderer give"


@pytest.mark.parametrize(
    ("times_ms", "why"), [([0, 10, 10, 20], "not later than the one before"), ([0, 1e-6, 2e-6, 3e-6], NANOSECONDS)]
)
def test_times_that_do_not_go_on_and_milliseconds_for_nanoseconds_are_an_error(times_ms, why):
    images = scene_of(lambda _, k: k, {"images": "pushed"}, times_ms=times_ms)
    with images as (scene, _), pytest.raises(SceneError, match=why):
        lit(scene, 15)


def test_the_images_for_one_light_frame_have_a_bound(monkeypatch):
    monkeypatch.setattr("emulator.scene.external.external._MOST_A_FRAME", 5)
    with scene_of(lambda _, k: k, {"images": "pushed"}, times_ms=range(20)) as (scene, _):
        lit(scene, 4)
        with pytest.raises(SceneError, match="more than 5 images came for one light frame"):
            lit(scene, 15)


@pytest.mark.parametrize(
    ("layer", "value"),
    [
        ("light", math.nan),
        ("light", -1e-3),
        ("light", math.inf),
        ("motion", math.nan),
        ("depth", -1),
        ("rate", math.inf),
    ],
)
def test_an_image_with_a_bad_number_ends_the_scene(layer, value):
    def spoil(image, k):
        if k == 1:
            getattr(image, layer)[2, 3] = value

    layers = Images(motion=True, depth=True, rate=True)
    with scene_of(lambda *_: 1, images=layers, change=spoil) as (scene, _):
        lit(scene, 0)
        with pytest.raises(SceneError, match=f"image 1: {layer} is .* in row 2, column 3"):
            lit(scene, 3)


def test_an_infinite_depth_is_the_sky():
    def sky(image, _):
        image.depth[:] = math.inf

    with scene_of(lambda *_: 1, images=Images(motion=True, depth=True), change=sky) as (scene, _):
        assert lit(scene, 3) == (2, 0)


def test_a_renderer_that_fails_ends_the_scene_with_its_reason():
    def fail(_, k):
        if k == 2:
            raise ValueError("the scene file is gone")

    with scene_of(lambda *_: 1, {"ahead": 0}, change=fail) as (scene, _):
        lit(scene, 5)
        with pytest.raises(SceneError, match="ValueError: the scene file is gone"):
            lit(scene, 15)


def test_the_pose_of_the_path_is_sent():
    with scene_of(lambda *_: 1, {"camera": FixedPath()}) as (scene, renderer):
        lit(scene, 0)
        assert scene.camera_path is not None
    np.testing.assert_allclose(renderer.poses[0].position_m, FixedPath().position_m)


def free_udp_port():
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        one.bind(("127.0.0.1", 0))
        return one.getsockname()[1]


def is_free(port):
    with socket.socket(type=socket.SOCK_DGRAM) as one:
        try:
            one.bind(("127.0.0.1", port))
        except OSError:
            return False
    return True


def test_a_live_path_is_counted_and_its_port_closed_with_the_scene():
    port = free_udp_port()
    with scene_of(lambda *_: 1, {"camera": LivePath(port=port)}) as (scene, _):
        assert not is_free(port)
        assert "poses taken" in scene.counts
    assert is_free(port)


def test_the_port_of_a_live_path_is_closed_where_no_renderer_connects():
    port = free_udp_port()
    with pytest.raises(SceneError, match="no renderer connected"):
        open_external(ExternalParameters(port=free_port(), wait_s=0.1, camera=LivePath(port=port)), PINHOLE)
    assert is_free(port)


def test_no_renderer_is_an_error_that_says_what_to_do():
    p = ExternalParameters(port=free_port(), wait_s=0.1)
    with pytest.raises(SceneError, match=r"no renderer connected to 127.0.0.1 port \d+ within 0.1 s"):
        open_external(p, PINHOLE)


@pytest.mark.parametrize(
    "wrong", [{"port": 0}, {"period_ms": 0.0}, {"ahead": 17}, {"host": "0.0.0.0"}, {"white_w_m2_sr": math.nan},
              {"images": "pushed", "camera": FixedPath()}],
)  # fmt: skip
def test_parameters_out_of_range_are_refused(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong)) if len(wrong) == 1 else "camera"):
        ExternalParameters(**wrong)
