"""Light between two drawings, beside closed forms, another library's splines, exact drawings, and itself."""

import dataclasses
import threading

import numpy as np
import pytest
from scipy.ndimage import distance_transform_edt, map_coordinates

from emulator.geometry.camera import Seen
from emulator.light import SceneError
from emulator.rig.loading import load_rig
from emulator.run.assembly import build_scene
from emulator.scene.between import FAST_PX, OFTEN, SELDOM, WINDOW, LightBetween
from emulator.scene.kind import SizedScene
from emulator.scene.moved_light import MARGIN, carry_into_sky, spline
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.live import GivenPath, SimulatedPath

SIZE = WIDTH, HEIGHT = 96, 64
STEP_NS = 10_000_000
ROWS, COLUMNS = np.mgrid[:HEIGHT, :WIDTH] + 0.0
CENTRE = 0.5 * np.array([WIDTH, HEIGHT])


class Moving(SizedScene):
    """A pattern that moves at `speed_px_s`, of which everything is known in closed form."""

    motion_bound_px_s = 1e3
    is_known_ahead = True

    def __init__(self, speed_px_s=(150.0, -60.0), ends_ns=10**18):
        super().__init__(SIZE)
        self.speed, self.ends_ns, self.drawn_ns, self.threads = speed_px_s, ends_ns, [], set()

    def phases(self, t_ns):
        x, y = COLUMNS - self.speed[0] * t_ns * 1e-9, ROWS - self.speed[1] * t_ns * 1e-9
        return [(0.5, 0.55, 0.2), (0.3, -0.25, 0.6)], x, y

    def light_and_rate(self, t_ns, light, rate):
        if t_ns > self.ends_ns:
            raise SceneError("the camera is below the ground")
        self.drawn_ns.append(t_ns)
        self.threads.add(threading.get_ident())
        waves, x, y = self.phases(t_ns)
        light[:] = 1 + sum(height * np.sin(kx * x + ky * y) for height, kx, ky in waves)
        rate[:] = -sum(h * np.cos(kx * x + ky * y) * (kx * self.speed[0] + ky * self.speed[1]) for h, kx, ky in waves)

    def flow(self, out):
        out.flow[:], out.labels[:] = self.speed, 1
        return True


class Growing(Moving):
    """Light at rest that is a cubic of time in each pixel."""

    def light_and_rate(self, t_ns, light, rate):
        self.drawn_ns.append(t_ns)
        a, t = 1 + 0.01 * COLUMNS, t_ns * 1e-9
        light[:], rate[:] = 1 + a * t**2 + ROWS * t**3, 2 * a * t + 3 * ROWS * t**2


class Disc(Moving):
    """A disc before the black sky, whose edge is a pixel wide."""

    def light_and_rate(self, t_ns, light, rate):
        self.drawn_ns.append(t_ns)
        x, y = COLUMNS - CENTRE[0] - self.speed[0] * t_ns * 1e-9, ROWS - CENTRE[1] - self.speed[1] * t_ns * 1e-9
        light[:] = np.clip((14 - np.hypot(x, y)) / 1.5, 0, 1)
        rate[:] = 0  # not used: it moves too far
        self.labels = light > 0

    def flow(self, out):
        out.flow[:], out.labels[:] = np.where(self.labels[..., None], self.speed, 0), self.labels
        return True


def drawn(scene, t_ns):
    light, rate = np.zeros((2, *scene.size[::-1]), np.float32)
    scene.light_and_rate(t_ns, light, rate)
    return light, rate


def within(array, columns):
    return array[16:-16, columns:-columns]


def test_the_spline_is_that_of_another_library():
    light = np.random.default_rng(1).random((HEIGHT, WIDTH)).astype(np.float32)
    out = np.zeros((HEIGHT + 2 * MARGIN, WIDTH + 2 * MARGIN), np.float32)
    spline(light, out)
    places = np.mgrid[-MARGIN : HEIGHT + MARGIN, -MARGIN : WIDTH + MARGIN].reshape(2, -1)
    inner = out[MARGIN:-MARGIN, MARGIN:-MARGIN]
    # With coefficients in place of pixels it is the spline through the pixels; mirrored it is the margin.
    again = map_coordinates(
        inner.astype(float), np.mgrid[:HEIGHT, :WIDTH] + 0.0, order=3, prefilter=False, mode="mirror"
    )
    np.testing.assert_allclose(again, light, atol=2e-6)
    mirrored = map_coordinates(inner.astype(float), places, order=0, prefilter=False, mode="mirror")
    np.testing.assert_allclose(out.reshape(-1), mirrored, atol=1e-6)


def test_the_sky_has_the_flow_of_the_nearest_surface():
    rng = np.random.default_rng(2)
    labels = np.zeros((HEIGHT, WIDTH), np.uint16)
    for row, column, radius in ((20, 30, 9), (40, 70, 5), (5, 90, 3)):
        labels[np.hypot(ROWS - row, COLUMNS - column) < radius] = 1
    flow = rng.random((HEIGHT, WIDTH, 2)).astype(np.float32)
    flow[20, 30] = np.inf
    before = flow.copy()
    carry_into_sky(labels, flow, np.zeros_like(flow), 7.0)
    away, nearest = distance_transform_edt(labels == 0, return_indices=True)
    sky = (labels == 0) & (away <= 7)
    same = np.all(flow[sky] == before[tuple(nearest)][sky], axis=-1)
    assert same.mean() > 0.85  # others have a pixel as near, or one of the two sweeps' small errors
    sources = before[labels == 1]
    assert all(np.any(np.all(value == sources, axis=-1)) for value in flow[sky])
    far = (labels == 0) & (away > 7.1)
    np.testing.assert_array_equal(flow[far], before[far])
    assert not flow[20, 30].any()


@pytest.mark.parametrize(("speed", "columns"), [((150.0, -60.0), 16), ((20.0, 30.0), 16), ((-900.0, 0.0), 40)])
def test_a_moving_pattern_has_its_closed_form(speed, columns):
    """But for pixels that the pattern enters or leaves within a period."""
    exact = Moving(speed)
    with LightBetween(Moving(speed), STEP_NS) as scene:
        for t_ns in (0, 3_000_000, 17_000_000, 25_500_000, 40_000_000, 639_000_000):
            light, rate = drawn(scene, t_ns)
            expected, expected_rate = drawn(exact, t_ns)
            np.testing.assert_allclose(within(light, columns), within(expected, columns), atol=4e-3)
            assert (
                np.abs(within(rate, columns) - within(expected_rate, columns)).max()
                < 0.02 * np.abs(expected_rate).max()
            )


def test_light_at_rest_is_the_cubic_through_values_and_rates():
    exact = Growing((0.0, 0.0))
    with LightBetween(Growing((0.0, 0.0)), STEP_NS, 40_000_000) as scene:
        for t_ns in (1_234_567_891, 1_235_000_000, 1_270_000_000):
            for got, expected in zip(drawn(scene, t_ns), drawn(exact, t_ns), strict=True):
                np.testing.assert_allclose(got, expected, rtol=1e-5)


def test_an_outline_moves_with_its_body():
    exact, period_ns = Disc(), 80_000_000  # 12 pixels
    with LightBetween(Disc(), STEP_NS, period_ns) as scene:
        for t_ns in (20_000_000, 40_000_000, 55_000_000):
            light, _ = drawn(scene, t_ns)
            expected, _ = drawn(exact, t_ns)
            blended = 0.5 * (drawn(exact, 0)[0] + drawn(exact, period_ns)[0])
            assert np.abs(light - expected).max() < 0.1 < 0.5 < np.abs(blended - expected).max()


def test_what_enters_the_frame_is_taken_from_the_drawing_that_contains_it():
    exact = Moving((-900.0, 0.0))  # 36 pixels a period
    with LightBetween(Moving((-900.0, 0.0)), STEP_NS) as scene:
        light, _ = drawn(scene, 20_000_000)
        np.testing.assert_allclose(light[8:-8, 8:-8], drawn(exact, 20_000_000)[0][8:-8, 8:-8], atol=0.02)


def test_an_instant_has_the_same_bits_whatever_was_drawn_before_and_by_any_threads():
    instants_ns = [5_000_000, 640_000_000, 20_000_000, 13_000_000, 1_300_000_000, 655_000_000, 20_000_001]
    alone = {}
    for t_ns in instants_ns:
        with LightBetween(Disc(), STEP_NS, threads=1) as scene:
            alone[t_ns] = drawn(scene, t_ns)
    light, rate = np.zeros((2, HEIGHT, WIDTH), np.float32)
    pixels = np.arange(0, WIDTH * HEIGHT, 7)
    with LightBetween(Disc(), STEP_NS, threads=3) as scene:
        for t_ns in [*instants_ns, *instants_ns[::-1], *sorted(instants_ns)]:
            scene.light_and_rate(t_ns, light, rate)  # over the last one
            for got, expected in zip((light, rate), alone[t_ns], strict=True):
                np.testing.assert_array_equal(got, expected)
            if t_ns % (SELDOM * STEP_NS):
                for got, expected in zip(scene.pixels(t_ns, pixels), alone[t_ns], strict=True):
                    np.testing.assert_array_equal(got, expected.reshape(-1)[pixels])


def test_a_jump_to_a_drawing_does_not_take_its_room():
    """Two pairs hold three drawings; the one that is jumped to takes the last room, and the next one another."""
    period_ns = 4 * STEP_NS
    jump_ns = 100 * period_ns
    with LightBetween(Disc((3.0, 1.0)), STEP_NS, period_ns) as scene:
        for t_ns in (0, STEP_NS, period_ns + STEP_NS):
            drawn(scene, t_ns)
        scene.wait()
        drawn(scene, jump_ns)
        assert jump_ns in scene._drawn
        assert len({id(task.result().drawing.light) for task in scene._drawn.values()}) == len(scene._drawn)


def test_only_what_may_differ_is_written_again():
    light, rate = np.full((2, HEIGHT, WIDTH), np.nan, np.float32)
    with LightBetween(Disc((0.0, 30.0)), STEP_NS) as scene:
        scene.light_and_rate(5_000_000, light, rate)
        assert scene.changed is None
        assert np.isfinite(light).all()
        assert np.isfinite(rate).all()
        light[0] = -1
        scene.light_and_rate(15_000_000, light, rate)
        assert scene.changed is not None
        assert (light[0] == -1).all()


@pytest.mark.parametrize(("speed_px_s", "steps"), [(0.9 * FAST_PX * 100, OFTEN), (1.1 * FAST_PX * 100, SELDOM)])
def test_drawings_follow_the_motion_of_the_image(speed_px_s, steps):
    inner = Moving((speed_px_s, 0.0))
    with LightBetween(inner, STEP_NS) as scene:
        for k in range(2 * WINDOW):
            drawn(scene, k * STEP_NS)
    wanted = range(0, 2 * WINDOW + 2 * steps, steps)
    assert sorted(inner.drawn_ns) == [k * STEP_NS for k in wanted][: len(inner.drawn_ns)]
    assert len(inner.drawn_ns) >= 2 * WINDOW // steps
    assert threading.get_ident() not in inner.threads


def test_frames_before_a_drawing_that_fails_are_drawn():
    exact, inner = Moving(), Moving(ends_ns=70_000_000)
    with LightBetween(inner, STEP_NS) as scene:
        for t_ns in (40_000_000, 60_000_000, 70_000_000):
            for got, expected in zip(drawn(scene, t_ns), drawn(exact, t_ns), strict=True):
                np.testing.assert_array_equal(got, expected)
        light, _ = scene.pixels(60_000_000, np.array([700]))
        assert light[0] == drawn(exact, 60_000_000)[0].reshape(-1)[700]
        with pytest.raises(SceneError, match="below the ground"):
            drawn(scene, 75_000_000)


def rig_of(name, **run):
    rig = load_rig(name)
    return dataclasses.replace(rig, run=dataclasses.replace(rig.run, **run))


@pytest.mark.parametrize(
    ("name", "run", "is_between"),
    [
        ("eros", {}, True),
        ("eros", {"drawing_us": 80_000}, False),
        ("eros", {"drawing_us": 80_001}, True),
        ("eros", {"tolerance_us": 100.0}, False),
        ("eros", {"tolerance_us": 100.0, "drawing_us": 400_000}, True),
        ("eros", {"method": "line"}, False),
        ("stars", {}, False),
        ("checkerboard", {}, False),
    ],
)
def test_the_scenes_that_are_drawn_seldom(name, run, is_between):
    rig = rig_of(name, **run)
    with build_scene(rig, (48, 36)) as scene:
        assert isinstance(scene, LightBetween) == is_between


@pytest.mark.parametrize("drawing_us", [0, 160_000])
def test_where_poses_come_from_outside_each_frame_is_drawn(drawing_us, caplog):
    """A period that the rig gives is reported as not used."""
    rig = rig_of("eros", drawing_us=drawing_us)
    path = SimulatedPath(build_trajectory(rig.scene.camera))
    given = dataclasses.replace(rig.scene, camera=GivenPath(rig.scene.camera, path))
    with build_scene(dataclasses.replace(rig, scene=given), (48, 36)) as scene:
        assert not isinstance(scene, LightBetween)
    assert ("run.drawing_us is not used" in caplog.text) == (drawing_us > 0)


def test_the_flow_of_facets_is_that_of_shapes_and_poses():
    size, t_ns = (160, 120), 10**10
    with build_scene(rig_of("eros", drawing_us=1), size) as scene:
        drawn(scene, t_ns)
        by_facets, by_shapes = Seen.of(*size), Seen.of(*size)
        assert scene.flow(by_facets)
        scene.geometry().look(t_ns, by_shapes)
    both = (by_facets.labels > 0) & (by_shapes.labels > 0)
    assert both.sum() > 0.99 * (by_shapes.labels > 0).sum() > 1000
    away = np.linalg.norm(by_facets.flow - by_shapes.flow, axis=-1)[both]
    assert np.quantile(away, 0.99) < 0.01 * np.linalg.norm(by_shapes.flow, axis=-1)[both].mean()


@pytest.mark.parametrize(("name", "share"), [("eros", 0.25), ("malapert", 0.75)])
def test_frames_of_rigs_are_near_exact_drawings(name, share):
    """Within a share of what a mean of the drawings around lacks: shadows that move over the ground are blended."""
    size, step_ns = (320, 240), load_rig(name).run.step_us * 1000
    with build_scene(rig_of(name, drawing_us=1), size) as scene:
        light, rate = drawn(scene, 125 * step_ns)
        still = 0.5 * (drawn(scene, 124 * step_ns)[0] + drawn(scene, 126 * step_ns)[0])
    with build_scene(load_rig(name), size) as scene:
        between, rate_between = drawn(scene, 125 * step_ns)
    assert np.std(between - light) < share * np.std(still - light)
    assert np.std(rate_between - rate) < share * np.std(rate)
