"""Laws of reflection against closed forms of whole spheres, and their GLSL against themselves."""

import math

import numpy as np
import pytest

from emulator.gl.context import open_context
from emulator.photometry.reflectance import (
    LUMENS_A_WATT,
    Glossy,
    Hapke,
    Lambert,
    LommelSeeliger,
    LunarLambert,
    Sun,
    Water,
    _behind_waves,
    air_light,
    henyey_greenstein,
)

LAWS = [
    Lambert(0.7),
    LommelSeeliger(0.33, -0.25),
    LunarLambert(0.12),
    Hapke(0.4, -0.3, 1.1, 0.06),
    Glossy(0.3, 0.5, 60.0),
]


def disc_i_over_f(law, phase):
    """Mean of pi r over the disc of a sphere seen at `phase`: the geometric albedo at phase 0."""
    n = 1001
    axis = (np.arange(n) + 0.5) / n * 2 - 1
    x, y = np.meshgrid(axis, axis)
    inside = x * x + y * y < 1
    z = np.sqrt(np.where(inside, 1 - x * x - y * y, 0))
    mu0 = x * math.sin(phase) + z * math.cos(phase)
    return float(np.where(inside, math.pi * law.reflect(mu0, z, phase), 0).sum() / inside.sum())


@pytest.mark.parametrize("phase", [0.0, 0.5, 1.5, 2.5])
def test_a_lambert_sphere_s_phase_curve(phase):
    expected = 2 / 3 * 0.7 * (math.sin(phase) + (math.pi - phase) * math.cos(phase)) / math.pi
    assert disc_i_over_f(Lambert(0.7), phase) == pytest.approx(expected, rel=2e-3, abs=1e-4)


@pytest.mark.parametrize("phase", [1e-6, 0.5, 1.5, 2.5])
def test_a_lommel_seeliger_sphere_s_phase_curve(phase):
    law = LommelSeeliger(0.33, -0.25)
    curve = 1 - math.sin(phase / 2) * math.tan(phase / 2) * math.log(1 / math.tan(phase / 4))
    expected = 0.33 / 8 * float(henyey_greenstein(phase, -0.25)) * curve
    assert disc_i_over_f(law, phase) == pytest.approx(expected, rel=3e-3, abs=1e-5)


def test_hapke_without_surge_and_scattering_often_is_lommel_seeliger():
    hapke, single = Hapke(1e-4, -0.25, 0.0), LommelSeeliger(1e-4, -0.25)
    assert hapke.reflect(0.6, 0.4, 0.9) == pytest.approx(single.reflect(0.6, 0.4, 0.9), rel=1e-3)


def test_hapke_s_sphere_at_zero_phase():
    """Geometric albedo: r0 / 2 + r0^2 / 6 + w / 8 ((1 + B0) P(0) - 1), Hapke 1993, eq. 10.33, within its own 1 %."""
    w, b, surge = 0.4, -0.3, 1.1
    r0 = (1 - math.sqrt(1 - w)) / (1 + math.sqrt(1 - w))
    expected = r0 / 2 + r0**2 / 6 + w / 8 * ((1 + surge) * float(henyey_greenstein(0.0, b)) - 1)
    assert disc_i_over_f(Hapke(w, b, surge, 0.06), 0.0) == pytest.approx(expected, rel=0.02)


def test_the_phase_function_s_mean_is_one():
    g = np.linspace(0, math.pi, 20001)
    mean = np.trapezoid(henyey_greenstein(g, -0.4) * np.sin(g), g) / 2
    assert mean == pytest.approx(1.0, abs=1e-6)


def test_ground_lit_and_seen_straight_on_is_the_moon_s_albedo():
    assert math.pi * LunarLambert(0.12).reflect(1.0, 1.0, 0.0) == pytest.approx(0.12)


@pytest.mark.parametrize("law", LAWS)
def test_the_night_side_is_black_and_no_light_is_made(law):
    assert law.reflect(np.array([-0.1, 0.0]), np.array([0.5, 0.5]), 1.0).max() == 0
    mu = (np.arange(400) + 0.5) / 400
    # Light thrown back over the half space from light straight down: never more than came.
    thrown = 2 * math.pi * np.mean(law.reflect(np.ones(400), mu, np.arccos(mu)) * mu)
    assert 0 < thrown < 1


def run_on_gl(law, angles):
    gl = open_context()
    with gl:
        shader = gl.compute_shader(
            "#version 430\nlayout(local_size_x = 1) in;\n"
            "layout(std430, binding = 0) buffer A { float a[]; };\n"
            "layout(std430, binding = 1) buffer R { float r[]; };\n" + law.glsl() + "void main() {\n"
            "    uint k = gl_GlobalInvocationID.x;\n"
            "    r[k] = reflect_sun(a[3 * k], a[3 * k + 1], a[3 * k + 2]);\n}"
        )
        out = gl.buffer(reserve=4 * len(angles))
        gl.buffer(angles).bind_to_storage_buffer(0)
        out.bind_to_storage_buffer(1)
        shader.run(len(angles))
        drawn = np.frombuffer(out.read(), np.float32)
    gl.release()
    return drawn


@pytest.mark.gl
@pytest.mark.parametrize("law", LAWS)
def test_glsl_says_the_same(law):
    rng = np.random.default_rng(1)
    angles = rng.uniform([-0.2, 0, 0.01], [1, 1, 3.0], (500, 3)).astype(np.float32)
    drawn = run_on_gl(law, angles)
    mu0, mu, phase = angles.astype(np.float64).T
    np.testing.assert_allclose(drawn, law.reflect(mu0, mu, phase), rtol=1e-4, atol=1e-7)


def test_a_glossy_surface_shines_where_a_mirror_would_and_gives_what_it_says():
    law = Glossy(0.0, 0.6, 400.0)
    angle = 0.5
    mirrored = law.reflect(math.cos(angle), math.cos(angle), 2 * angle)
    assert mirrored > 50 * law.reflect(math.cos(angle), math.cos(angle + 0.3), 2 * angle + 0.3)
    # over all directions that light from straight above leaves by: n.h is cos of half the angle
    e = (np.arange(20000) + 0.5) / 20000 * math.pi / 2
    thrown = 2 * math.pi * np.trapezoid(law.reflect(np.ones_like(e), np.cos(e), e) * np.cos(e) * np.sin(e), e)
    assert thrown == pytest.approx(0.6, rel=0.03)


def test_the_glint_passes_the_air_twice():
    law, mu0, mu, phase = Water(7.0), np.array([1.0, 0.5, 0.7]), np.array([1.0, 0.5, 0.4]), np.array([0.0, 2.0, 1.8])
    through = law.reflect(mu0, mu, phase) / without_air(law, mu0, mu, phase)
    np.testing.assert_allclose(through, np.exp(-0.126 * (1 / mu0 + 1 / mu)), rtol=2e-3)  # flat air, far from the limb
    grazing = float(law.reflect(1.0, 0.0, 1.5) / without_air(law, 1.0, 0.0, 1.5))
    assert -math.log(grazing) == pytest.approx(0.126 * (1 + math.sqrt(math.pi * 6371 / 16)), rel=0.01)
    mean = np.mean(0.0973 * (np.linspace(400, 700, 3001) / 550) ** -4.05)  # Bucholtz's power at these wavelengths
    assert mean == pytest.approx(0.126, rel=0.01)


def without_air(law, *angles):
    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("emulator.photometry.reflectance._AIR_DEPTH", 0.0)
        return law.reflect(*angles)


def test_air_gives_the_light_that_a_layer_scatters_once():
    """The layer in 20 000 sheets: each is lit through those above, and seen through them."""
    depth = (np.arange(20_000) + 0.5) / 20_000 * 0.126
    for mu0, mu, phase in ((1.0, 0.4, 1.1), (0.3, 0.9, 1.2), (0.5, 0.25, 0.3)):
        scattered = 3 / 4 * (1 + math.cos(phase) ** 2) / (4 * math.pi)
        expected = scattered * np.mean(np.exp(-depth / mu0 - depth / mu)) * 0.126 / mu
        assert float(air_light(np.array(mu0), np.array(mu), np.array(phase), 0.0)) == pytest.approx(expected, rel=0.01)
        half = air_light(np.array(mu0), np.array(mu), np.array(phase), 0.5)
        assert float(half) == pytest.approx(expected / 4, rel=0.01)


def test_air_is_dark_at_night_and_finite_at_the_limb():
    mu0, mu = np.array([-0.1, 0.0, 0.5, 1.0, 0.1]), np.array([0.5, 0.5, 0.0, 0.0, 0.0])
    light = air_light(mu0, mu, np.full(5, 1.0), 0.05)
    assert not light[:2].any()
    assert np.isfinite(light).all()
    assert (light[2:] > 0.02).all()


def test_water_mirrors_the_sun_as_often_as_slopes_drawn_at_random():
    """Facets with normal slopes (variance s / 2 on each axis) under the Sun at 40 degrees, each by what it catches."""
    law, angle = Water(5.0), math.radians(40.0)
    slope2 = 0.003 + 0.00512 * 5.0
    slopes = np.random.default_rng(4).normal(0, math.sqrt(slope2 / 2), (2_000_000, 2))
    normals = np.column_stack([-slopes, np.ones(len(slopes))])
    catch = normals @ [math.sin(angle), 0.0, math.cos(angle)]  # m2 of the beam for a m2 of the ground under the facet
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)
    cosine = normals @ [math.sin(angle), 0.0, math.cos(angle)]
    along = np.sqrt(1 - (1 - cosine**2) / 1.34**2)
    share = (
        ((cosine - 1.34 * along) / (cosine + 1.34 * along)) ** 2
        + ((1.34 * cosine - along) / (1.34 * cosine + along)) ** 2
    ) / 2
    leaves = 2 * cosine[:, None] * normals - [math.sin(angle), 0.0, math.cos(angle)]
    for turned in (-0.6, -0.9, -0.4):
        middle = np.array([math.sin(turned), 0.0, math.cos(turned)])
        radius = 0.06
        power = (share * catch)[leaves @ middle > math.cos(radius)].sum() / len(slopes)
        expected = power / (2 * math.pi * (1 - math.cos(radius)) * middle[2])
        found = without_air(law, math.cos(angle), middle[2], angle - turned)
        assert float(found) == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("cosine", [0.02, 0.1, 0.3])
def test_waves_hide_behind_waves_as_their_slopes_towards_the_eye_do(cosine):
    """Smith: the mean by which slopes along the line of sight, of variance s / 2, are steeper than it, over its own."""
    slope2, height = 0.04, cosine / math.sqrt(1 - cosine**2)
    slope = np.linspace(height, height + 3, 200_001)
    likely = np.exp(-(slope**2) / slope2) / math.sqrt(math.pi * slope2)
    expected = np.trapezoid((slope - height) * likely, slope) / height
    assert float(_behind_waves(np.array(cosine), slope2)) == pytest.approx(expected, rel=1e-5)


def test_water_is_the_same_both_ways_dark_at_night_and_finite_at_the_horizon():
    law = Water(7.0)
    mu0, mu, phase = np.array([0.9, 0.2, 0.5, 1e-3]), np.array([0.4, 0.6, 1e-3, 1e-3]), np.array([1.2, 0.9, 1.7, 3.1])
    np.testing.assert_allclose(law.reflect(mu0, mu, phase) * mu, law.reflect(mu, mu0, phase) * mu0, rtol=1e-9)
    assert float(without_air(law, 1.0, 1.0, 0.0)) == pytest.approx((0.34 / 2.34) ** 2 / (4 * math.pi * 0.03884))
    assert not law.reflect(np.array([0.0, -0.5]), np.array([0.5, 0.5]), 1.0).any()
    grid = np.linspace(0.0, 1.0, 101)
    assert np.isfinite(law.reflect(grid[:, None], grid, np.abs(np.arccos(grid[:, None]) + np.arccos(grid)))).all()


@pytest.mark.parametrize(
    ("make", "name"),
    [
        (lambda: Lambert(1.1), "albedo"),
        (lambda: LommelSeeliger(math.nan), "single_scattering_albedo"),
        (lambda: Hapke(asymmetry=1.0), "asymmetry"),
        (lambda: LunarLambert(-1.0), "albedo"),
        (lambda: Sun((0.0, 0.0, 0.0)), "direction"),
        (lambda: Sun(distance_au=0.0), "distance_au"),
    ],
)
def test_nonsense_is_refused(make, name):
    with pytest.raises(ValueError, match=f"{name} (is|must be) "):
        make()


def test_the_sun_from_eros():
    sun = Sun((0, 0, -2), 1.46)
    assert sun.irradiance_w_m2 == pytest.approx(248.6, rel=1e-3)
    assert sun.irradiance_w_m2 * LUMENS_A_WATT == pytest.approx(133_600 / 1.46**2)
    assert math.degrees(sun.radius_rad) == pytest.approx(0.1826, rel=1e-3)
