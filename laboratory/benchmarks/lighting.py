"""Milliseconds for the light of the shipped bodies and its rate, one thread.

python -m laboratory.benchmarks.lighting [REPEATS]
"""

from __future__ import annotations

import sys
import time
from pathlib import Path

from emulator.rig.loading import load_rig
from emulator.scene.bodies.lighting import Lighting, motion_at
from emulator.scene.bodies.lit_surface import lit_surface, subdivide
from emulator.scene.bodies.mesh import find_shape, load_mesh
from emulator.scene.bodies.table import BodiesParameters
from emulator.scene.bodies.world import Arrangement, PlacedBody
from emulator.trajectory.building import build_trajectory
from emulator.trajectory.pose import Timescale

RIGS = Path(__file__).parent.parent / "rigs"
FLAT_SIZE_M = 0.2
STEP_NS = 12_000_000  # between calls, as in a run: what is remembered of shadows counts


def _measure(name: str, repeats: int) -> str:
    scene = load_rig(str(RIGS / f"{name}.toml")).scene
    assert isinstance(scene, BodiesParameters)
    meshes = [load_mesh(find_shape(body.shape), body.units_m) for body in scene.bodies]
    surfaces = [
        lit_surface(mesh if body.smooth else subdivide(mesh, FLAT_SIZE_M), smooth=body.smooth)
        for body, mesh in zip(scene.bodies, meshes, strict=True)
    ]
    begun = time.perf_counter()
    lighting = Lighting(scene, meshes, surfaces)
    made_s = time.perf_counter() - begun
    names = [body.name for body in scene.bodies]
    placed = [
        PlacedBody(build_trajectory(b.path), names.index(b.fixed_to) if b.fixed_to else None, mesh.radius_m)
        for b, mesh in zip(scene.bodies, meshes, strict=True)
    ]
    camera, clock = build_trajectory(scene.camera), Timescale(scene.time_scale)
    arrangement = Arrangement(camera, placed, clock)
    motions = [motion_at(k * STEP_NS, camera, arrangement.poses, clock) for k in range(repeats)]
    lighting.light(motions[0])
    times_ms = []
    for motion in motions:
        begun = time.perf_counter()
        lighting.light(motion)
        times_ms.append(1e3 * (time.perf_counter() - begun))
    times_ms.sort()
    points = sum(len(surface.points) for surface in surfaces)
    return (
        f"{name:14} {points:7} points  {made_s:6.2f} s  {times_ms[0]:6.3f} ms  {times_ms[len(times_ms) // 2]:6.3f} ms"
    )


def main() -> None:
    """Print a line for each rig: points, making, least and median time of one call."""
    repeats = int(sys.argv[1]) if len(sys.argv) > 1 else 100
    print(f"{'rig':14} {'':7}         {'made':>8}  {'least':>9}  {'median':>9}")  # noqa: T201
    for name in ("itokawa", "eros", "eros-flyover", "rendezvous"):
        print(_measure(name, repeats), flush=True)  # noqa: T201


if __name__ == "__main__":
    main()
