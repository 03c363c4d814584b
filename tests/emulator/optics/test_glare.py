"""Scattered light against its definition and closed forms: light, rate, single pixels and the changed region."""

import numpy as np
import pytest

from emulator.light import Region, Scene, SceneFrames
from emulator.optics.glare import Veiled, veiled
from emulator.optics.lens import LensParameters

SIZE = 40, 30
MS = 1_000_000
WHOLE = Region(0, 30, 0, 40)
NONE = Region(0, 0, 0, 0)
EVEN = LensParameters(veiling_glare=0.05)
HALO = LensParameters(veiling_glare=0.01, halo=0.02, halo_px=4, halo_power=1.5)


class Lit(Scene):
    """A light that is a function of the time, s, and of the pixel's number, with its derivative; and what changed."""

    has_rate = True

    def __init__(self, light, rate):
        self._light, self._rate, self.now_changed, self.closed = light, rate, WHOLE, False

    @property
    def size(self):
        return SIZE

    @property
    def motion_bound_px_s(self):
        return 3.0

    @property
    def changed(self):
        return self.now_changed

    def light(self, t_ns, out):
        if not self.now_changed.empty:
            out[:] = self._light(t_ns * 1e-9, np.arange(1200)).reshape(30, 40)

    def light_and_rate(self, t_ns, light, rate):
        self.light(t_ns, light)
        if not self.now_changed.empty:
            rate[:] = self._rate(t_ns * 1e-9, np.arange(1200)).reshape(30, 40)

    def close(self):
        self.closed = True


def waves():
    """Light 1 + 0.5 sin(30 t + 0.01 k), whose mean is known as a sum."""
    return Lit(lambda t, k: 1 + 0.5 * np.sin(30 * t + 0.01 * k), lambda t, k: 15 * np.cos(30 * t + 0.01 * k))


def test_a_black_area_in_a_bright_field_has_the_index_and_the_field_its_light():
    """ISO 9358: the light in the black area's image over that of the field."""
    black = np.ones(1200)
    black[600] = 0
    scene = Veiled(Lit(lambda t, k: black[k], lambda t, k: 0 * black[k]), LensParameters(veiling_glare=0.03))
    light = np.zeros((30, 40), np.float32)
    scene.light(0, light)
    index = light.reshape(-1)[600] / light[0, 0]
    assert index == pytest.approx(0.03, rel=2e-3)
    assert light[0, 0] == pytest.approx(1, rel=1e-4)


def test_light_and_rate_are_those_of_the_image_and_of_its_mean():
    scene, t_s, k = Veiled(waves(), EVEN), 0.02, np.arange(1200)
    light, rate = (np.zeros((30, 40), np.float32) for _ in range(2))
    scene.light_and_rate(20 * MS, light, rate)
    own, own_rate = 1 + 0.5 * np.sin(30 * t_s + 0.01 * k), 15 * np.cos(30 * t_s + 0.01 * k)
    assert np.allclose(light.reshape(-1), 0.95 * own + 0.05 * own.mean(), atol=1e-6)
    assert np.allclose(rate.reshape(-1), 0.95 * own_rate + 0.05 * own_rate.mean(), atol=1e-5)
    alone = np.zeros((30, 40), np.float32)
    scene.light(20 * MS, alone)
    assert np.array_equal(alone, light)


def test_only_a_scene_in_which_nothing_changed_leaves_the_frame_as_it_is():
    inner = waves()
    frames = SceneFrames(Veiled(inner, EVEN), with_rate=True)
    first = frames.draw(0)
    assert first.changed is None
    before = first.light.copy()
    inner.now_changed = NONE
    still = frames.draw(MS)
    assert still.changed is not None
    assert still.changed.empty
    assert np.array_equal(still.light, before)
    inner.now_changed = Region(0, 1, 0, 1)
    assert frames.draw(2 * MS).changed is None
    assert not np.array_equal(frames.last.light, before)


def test_a_halo_falls_from_its_source_by_the_law_and_a_uniform_field_and_the_mean_stay():
    """The law, summed over a source of 3 x 4 pixels and its mirror images beside the frame."""
    image = np.zeros((30, 40))
    image[12:15, 20:24] = 100
    scene, light = (
        Veiled(Lit(lambda t, k: image.ravel()[k], lambda t, k: 0.0 * k), HALO),
        np.zeros((30, 40), np.float32),
    )
    scene.light(0, light)
    assert light.mean() == pytest.approx(image.mean(), rel=2e-4)
    rows, columns = (np.arange(-n, 2 * n) for n in image.shape)

    def law(y, x):
        dy, dx = (rows - y)[:, None], columns - x
        near = (dy >= -30) & (dy < 30) & (dx >= -40) & (dx < 40)
        return near * (1 + (dy**2 + dx**2) / HALO.halo_px**2) ** (-HALO.halo_power / 2)

    mirrored = np.pad(image, [(n, n) for n in image.shape], mode="symmetric")
    halo = np.array([[(mirrored * law(y, x)).sum() for x in range(40)] for y in range(30)])
    scattered = 0.01 * image.mean() + 0.02 * halo * image.sum() / halo.sum()
    y, x = np.mgrid[:30, :40]
    away = np.hypot(y - 13, x - 21.5) > 12
    assert np.abs(np.log(light / scattered))[away].max() < 0.03
    even = Veiled(Lit(lambda t, k: 1.0 + 0 * k, lambda t, k: 0.0 * k), HALO)
    even.light(0, light)
    assert np.allclose(light, 1, atol=1e-6)


def test_a_halo_moves_with_its_source():
    frames = SceneFrames(Veiled(waves(), LensParameters(halo=0.4, halo_px=4)), with_rate=True)
    early, late = (frames.draw(t_ns * MS // 1000).light.astype(np.float64) for t_ns in (19_999, 20_001))
    frame = frames.draw(20_001 * MS // 1000)
    assert np.allclose(frame.rate, (late - early) / 2e-6, atol=0.2)  # float32 light: 1e-7 over 2 us


def test_an_unknown_rate_leaves_those_of_other_pixels_known():
    scene = Veiled(
        Lit(lambda t, k: 1.0 + 0 * k, lambda t, k: np.where(k == 3, np.nan, 2.0)), LensParameters(veiling_glare=0.1)
    )
    light, rate = (np.zeros((30, 40), np.float32) for _ in range(2))
    scene.light_and_rate(0, light, rate)
    assert np.isnan(rate.reshape(-1)[3])
    assert np.isfinite(rate).sum() == 1199
    assert rate[0, 0] == pytest.approx(2, rel=1e-3)


def test_without_glare_the_scene_is_not_wrapped():
    inner = waves()
    assert veiled(inner, LensParameters()) is inner
    wrapped = veiled(inner, LensParameters(veiling_glare=0.02))
    assert isinstance(wrapped, Veiled)
    assert wrapped.scene is inner
    wrapped.close()
    assert inner.closed
    assert isinstance(veiled(inner, LensParameters(halo=0.01)), Veiled)


def test_an_impossible_index_is_refused():
    with pytest.raises(ValueError, match="veiling_glare"):
        LensParameters(veiling_glare=0.6)
