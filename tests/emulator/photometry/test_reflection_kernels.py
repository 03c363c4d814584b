"""The compiled laws of reflection against the formulas of `photometry.reflectance`, given angles instead of chords."""

import numpy as np
import pytest

from emulator.photometry.reflectance import Glossy, Hapke, Lambert, LommelSeeliger, LunarLambert
from emulator.photometry.reflection_kernels import law_of, reflect

LAWS = [
    Lambert(0.3),
    LommelSeeliger(0.33, -0.25),
    LommelSeeliger(0.9, 0.4),
    LunarLambert(0.12),
    Hapke(0.42, -0.35, 0.87, 0.01),
    Hapke(1.0, 0.0, 0.0, 0.05),
    Glossy(0.35, 0.45, 150.0),
    Glossy(0.0, 1.0, 600.0),
    Glossy(0.1, 0.2, 1.0),
]


def unit(v):
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def angles(phase):
    """Return mu0, mu, chord squared and phase of random surfaces at given phase angles."""
    random = np.random.default_rng(3)
    normal, sun, aside = (unit(random.normal(size=(len(phase), 3))) for _ in range(3))
    across = unit(np.cross(sun, aside))
    eye = sun * np.cos(phase)[:, None] + across * np.sin(phase)[:, None]
    chord2 = (2 * np.sin(phase / 2)) ** 2
    return (normal * sun).sum(axis=1), (normal * eye).sum(axis=1), chord2, phase


@pytest.mark.parametrize("law", LAWS, ids=repr)
def test_laws_agree(law):
    phase = np.concatenate([np.linspace(0, np.pi - 1e-3, 3000), np.geomspace(1e-7, 1e-2, 1000)])
    mu0, mu, chord2, phase = angles(phase)
    out = np.full(len(phase), np.nan)
    reflect(*law_of(law), mu0, mu, chord2, len(phase), out)
    expected = law.reflect(mu0, mu, phase)
    if isinstance(law, LunarLambert):  # its phase function is a table, coarse where the Sun is nearly behind
        near = phase < np.radians(150)
        np.testing.assert_allclose(out[near], expected[near], rtol=0, atol=4e-6 * expected.max())
        np.testing.assert_allclose(out[~near], expected[~near], rtol=0, atol=4e-4 * expected.max())
    else:
        np.testing.assert_allclose(out, expected, rtol=1e-6, atol=1e-20)
    assert (out[mu0 <= 0] == 0).all()
    assert (out[mu0 > 0.01] >= 0).all()


@pytest.mark.parametrize("law", LAWS, ids=repr)
def test_extreme_angles_are_finite(law):
    mu0 = np.array([0.0, 1.0, 1e-300, 1.0, -1.0, 1.0])
    mu = np.array([0.0, 0.0, -1e-300, -1.0, 1.0, 1.0])
    chord2 = np.array([0.0, 4.0, 4.0, 4.0, 4.0, 0.0])
    out = np.full(6, np.nan)
    reflect(*law_of(law), mu0, mu, chord2, 6, out)
    assert np.isfinite(out).all()
