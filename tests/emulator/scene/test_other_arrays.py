"""Scenes that write again only what has changed: other arrays are written whole, and all of them may have changed."""

import numpy as np
import pytest

from emulator.optics.lens import LensParameters
from emulator.rig.kinds import CAMERA_MODELS
from emulator.scene.bodies.raster_bodies import RasterBodies
from emulator.scene.bodies.table import BodiesParameters, BodyTable
from emulator.scene.checkerboard.checkerboard import Checkerboard
from emulator.scene.checkerboard.table import CheckerboardParameters
from emulator.scene.kind import Blank
from emulator.scene.stars.stars import StarField
from emulator.scene.stars.table import StarsParameters
from emulator.scene.terrain.raster_terrain import RasterTerrain
from emulator.trajectory.parameters import FixedPath
from tests.emulator.scene.terrain.test_raster_terrain import CAMERA, own_cache, parameters

__all__ = ["own_cache"]

SIZE = CAMERA.size
BALL = BodiesParameters(bodies=(BodyTable(shape="globe"),), camera=FixedPath((0.0, 0.0, -4.0)))
CHIP = CAMERA_MODELS["davis346"].chip
SCENES = {
    "blank": lambda: Blank(SIZE),
    "board": lambda: Checkerboard(CheckerboardParameters(speed_px_s=0.0), SIZE),
    "stars": lambda: StarField(StarsParameters(faintest_v=6.0, sky_w_m2_sr=1e-7), SIZE, LensParameters(), CHIP),
    "bodies": lambda: RasterBodies(BALL, CAMERA),
    "terrain": lambda: RasterTerrain(parameters(), CAMERA),
}


@pytest.mark.parametrize("name", SCENES)
def test_other_arrays_are_written_whole_and_may_have_changed(name):
    first, other = (np.full((2, *SIZE[::-1]), np.nan, np.float32) for _ in range(2))
    light, rate = first
    with SCENES[name]() as scene:
        scene.light_and_rate(0, light, rate)
        assert scene.changed is None
        expected = first.copy()
        scene.light_and_rate(0, light, rate)
        assert scene.changed is not None
        for arrays in (tuple(other), (light, other[1]), (light, rate)):
            for array in arrays:
                array[:] = np.nan
            scene.light_and_rate(0, *arrays)
            assert scene.changed is None
            np.testing.assert_array_equal(np.stack(arrays), expected)
