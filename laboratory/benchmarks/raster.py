"""CPU time and errors of the CPU renderer of terrain.

python -m laboratory.benchmarks.raster [--check] [SECONDS ...]
"""

from __future__ import annotations

from functools import partial

import numpy as np
from cyclopts import App

from emulator.geometry.camera import Pinhole
from emulator.rig.loading import load_rig
from emulator.scene.terrain.raster_terrain import RasterTerrain, camera_motion
from laboratory.accuracy.sampled_scenes import SampledTerrain
from laboratory.benchmarks.kernels import seconds

app = App(name="raster")

SIZES = ((346, 260), (1280, 720))
FIELD_DEG = 60.0
TIMES_S = (20, 45, 70)
SAMPLES = 8


@app.default
def terrain(*times_s: int, check: bool = False) -> None:
    """Print the time of shading a pixel of the rig malapert: one thread, the least of nine, without and with the rate.

    With --check, errors of light in % of the mean light against 8 x 8 point samples of every facet of the map
    (`SampledTerrain`), which takes seconds to a minute a light frame.
    """
    parameters = load_rig("malapert").scene
    for size in SIZES:
        pinhole = Pinhole.of_field(size, FIELD_DEG)
        light = np.zeros(size[::-1], np.float32)
        with RasterTerrain(parameters, pinhole) as scene:
            for t_s in times_s or TIMES_S:
                scene.light(t_s * 10**9, light)
                error = errors(parameters, pinhole, t_s, light.copy()) if check else ""
                alone, both = (shading_ns(scene, t_s, light, with_rate=with_rate) for with_rate in (False, True))
                print(f"{size[0]} x {size[1]}, {t_s} s: {alone:.0f} ns a pixel, with rate {both:.0f} ns{error}")


def shading_ns(scene: RasterTerrain, t_s: int, light: np.ndarray, *, with_rate: bool) -> float:
    (_, camera), rate = camera_motion(t_s * 10**9, scene.camera_path, scene.path_time), np.zeros_like(light)
    shade = partial(scene._shade, camera, light, rate, with_rate=with_rate)
    return min(seconds(shade) for _ in range(9)) / light.size * 1e9


def errors(parameters, pinhole, t_s: int, light: np.ndarray) -> str:
    truth = np.zeros_like(light)
    with SampledTerrain(parameters, pinhole, SAMPLES) as sampled:
        sampled.light(t_s * 10**9, truth)
    off = np.abs(light - truth) / truth.mean() * 100
    return f"; error: median {np.median(off):.3f}, p99 {np.percentile(off, 99):.1f}, mean {off.mean():.3f} %"


if __name__ == "__main__":
    app()
