"""The light from all around in the rendezvous rig is that of the Earth at its distance."""

import numpy as np
import pytest

from emulator.photometry.reflectance import EARTHLIGHT_W_M2
from emulator.rig.loading import load_rig

RADIUS_M, MOON_M = 6_371_000.0, 384_400_000.0


@pytest.fixture(scope="module")
def scene():
    return load_rig("rendezvous").scene


@pytest.fixture(scope="module")
def globe(scene):
    (found,) = (body for body in scene.bodies if body.shape == "globe")
    return found


def earthlight_w_m2(scene, globe, away=1.0, points=200_000):
    """Return what a surface at the origin that faces the globe gets: a sum over its lit ground, which is Lambert's.

    The globe is put `away` times as far off as the rig has it.
    """
    k = np.arange(points) + 0.5
    z, turn = 1 - 2 * k / points, k * np.pi * (3 - np.sqrt(5))
    normals = np.stack([np.sqrt(1 - z * z) * np.cos(turn), np.sqrt(1 - z * z) * np.sin(turn), z], axis=-1)
    places = away * np.array(globe.path.position_m) + RADIUS_M * normals
    range_m = np.linalg.norm(places, axis=1)
    sun = np.array(scene.sun.direction) / np.linalg.norm(scene.sun.direction)
    middle = np.array(globe.path.position_m) / np.linalg.norm(globe.path.position_m)
    lit, seen = np.maximum(normals @ sun, 0), np.maximum(-(normals * places).sum(axis=1) / range_m, 0)
    radiance = globe.reflectance.albedo / np.pi * scene.sun.irradiance_w_m2 * lit
    share = 4 * np.pi * RADIUS_M**2 / points * seen / range_m**2
    return float((radiance * share * (places @ middle) / range_m).sum())


def phase(scene, globe):
    """Return the light of Lambert's sphere beside that of a full one."""
    place, sun = np.array(globe.path.position_m), np.array(scene.sun.direction)
    angle = np.arccos(-(place @ sun) / np.linalg.norm(place) / np.linalg.norm(sun))
    return (np.sin(angle) + (np.pi - angle) * np.cos(angle)) / np.pi


def test_the_sum_is_the_closed_form_of_a_far_globe(scene, globe):
    range_m = 100 * np.linalg.norm(globe.path.position_m)
    full = scene.sun.irradiance_w_m2 * globe.reflectance.albedo * 2 / 3 * (RADIUS_M / range_m) ** 2
    assert earthlight_w_m2(scene, globe, away=100.0) == pytest.approx(full * phase(scene, globe), rel=2e-3)


def test_it_lies_between_the_globe_as_drawn_and_earthlight_as_measured(scene, globe):
    range_m = np.linalg.norm(globe.path.position_m)
    measured = EARTHLIGHT_W_M2 * (MOON_M / range_m) ** 2 * phase(scene, globe)
    assert earthlight_w_m2(scene, globe) < scene.ambient_w_m2 < measured
