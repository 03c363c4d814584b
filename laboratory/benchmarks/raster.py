"""CPU time and errors of the CPU renderer: on the shipped shapes, and on terrain.

python -m laboratory.benchmarks.raster shapes [--check] [NAME ...]
python -m laboratory.benchmarks.raster terrain [--check] [SECONDS ...]
"""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from cyclopts import App

from emulator.geometry.camera import Pinhole
from emulator.raster import Box, Renderer, Screen, View, join, prepare
from emulator.rig.loading import load_rig
from emulator.scene.bodies.lit_surface import lit_surface
from emulator.scene.bodies.mesh import find_shape, load_mesh
from emulator.scene.bodies.regolith import detailed
from emulator.scene.terrain.raster_terrain import RasterTerrain, camera_motion
from laboratory.accuracy.sampled_scenes import SampledTerrain

app = App(name="raster")

SIZES = ((346, 260), (1280, 720))


@dataclass(frozen=True)
class Body:
    """A shape, its place at time 0 in the camera's axes, and how it turns about its origin or another body's."""

    shape: str
    units_m: float
    offset_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    flat: bool = False
    turned: bool = False


@dataclass(frozen=True)
class Case:
    """Bodies that turn together before a camera."""

    bodies: tuple[Body, ...]
    place_m: tuple[float, float, float]
    pole: tuple[float, float, float]
    spin_rad_s: float
    field_deg: float
    sun: tuple[float, float, float]


CASES = {
    "itokawa": Case((Body("itokawa_49152", 1000.0),), (0, 0, 7000), (0.15, 1, 0.1), 0.0863, 5.2, (-0.34, -0.1, -0.94)),
    "eros-flyover": Case((Body("eros022540", 1000.0),), (0, 0, 35000), (0.3, 0.9, 0.2), 0.0994, 22, (0.5, -0.6, -0.6)),
    "rendezvous": Case(
        (
            Body("target_bus", 1.0, flat=True),
            Body("target_panel", 1.0, (0.8, 0, 0), flat=True),
            Body("target_panel", 1.0, (-0.8, 0, 0), flat=True, turned=True),
            Body("target_ring", 1.0, flat=True),
            Body("target_plate", 1.0, flat=True),
            Body("target_marks", 1.0, flat=True),
        ),
        (0.5, 0.2, 12),
        (0.2, 0.3, -1),
        0.0873,
        40,
        (-0.5, -0.45, -0.75),
    ),
}


class Scene:
    """The vertices, normals and facets of a case, and its view at any time."""

    def __init__(self, name: str) -> None:
        case = self.case = CASES[name]
        details = {body.shape: body.detail for body in load_rig(name).scene.bodies}
        parts = [self._part(body, details[body.shape]) for body in case.bodies]
        self.points, self.normals, self.albedo = (np.concatenate([p[k] for p in parts]) for k in (0, 1, 2))
        self.topology = join([p[3] for p in parts])
        self.pole = np.array(case.pole) / np.linalg.norm(case.pole)
        self.sun = np.array(case.sun) / np.linalg.norm(case.sun)

    def _part(self, body: Body, detail):
        mesh = load_mesh(find_shape(body.shape), body.units_m)
        range_m = np.linalg.norm(self.case.place_m) - mesh.radius_m
        mesh = detailed(mesh, detail, range_m / screen_of(self.case, SIZES[0]).focal_px)
        turn = np.diag([-1.0, -1, 1]) if body.turned else np.eye(3)
        if "target" in body.shape:  # the docking face, +z, towards the camera
            turn = np.diag([1.0, -1, -1]) @ turn
        surface = lit_surface(mesh, smooth=not body.flat)
        points = surface.vertices @ turn.T + np.array(body.offset_m)
        albedo = np.ones(len(surface.normals)) if surface.albedo is None else surface.albedo
        return points, surface.normals @ turn.T, albedo, prepare(surface.faces, shades=surface.shades)

    def view(self, t_s: float = 0.0) -> View:
        """Return the view at a time: Lambert's law with a little light from all around."""
        turn = _rotation(self.pole, 0.4 + self.case.spin_rad_s * t_s)
        points, normals = self.points @ turn.T, self.normals @ turn.T
        spin = self.pole * self.case.spin_rad_s
        incidence = normals @ self.sun
        rate = np.cross(spin, normals) @ self.sun
        lit = incidence > 0
        light, rate = self.albedo * (0.05 + incidence * lit), self.albedo * rate * lit
        return View(points + np.array(self.case.place_m), np.cross(spin, points), light, rate)


def _rotation(axis: np.ndarray, angle: float) -> np.ndarray:
    x, y, z = axis
    k = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + np.sin(angle) * k + (1 - np.cos(angle)) * (k @ k)


def screen_of(case: Case, size: tuple[int, int]) -> Screen:
    """Return the case's camera."""
    focal = size[0] / 2 / np.tan(np.radians(case.field_deg) / 2)
    return Screen(*size, focal, (size[0] / 2, size[1] / 2))


class Tracer:
    """Mean radiance of pixels from rays, by embree; shares nothing with the renderer but the facets."""

    def __init__(self, scene: Scene, screen: Screen, t_s: float) -> None:
        import trimesh
        from trimesh.ray.ray_pyembree import RayMeshIntersector

        view = scene.view(t_s)
        self.faces, self.shades, self.screen = scene.topology.faces, scene.topology.shades, screen
        self.points, self.radiance = view.positions_m, view.radiance
        mesh = trimesh.Trimesh(self.points, self.faces, process=False, validate=False)
        self.rays = RayMeshIntersector(mesh)

    def light(self, rows: np.ndarray, columns: np.ndarray, side: int) -> np.ndarray:
        """Return the mean of side x side rays of each pixel, (n,)."""
        out = np.zeros(len(rows))
        inner = (np.arange(side) + 0.5) / side
        v, u = (a.ravel() for a in np.meshgrid(inner, inner, indexing="ij"))
        chunk = max(1, (1 << 20) // side**2)
        for k in range(0, len(rows), chunk):
            x = (columns[k : k + chunk, None] + u).ravel()
            y = (rows[k : k + chunk, None] + v).ravel()
            out[k : k + chunk] = self._samples(x, y).reshape(-1, side * side).mean(axis=1)
        return out

    def _samples(self, x: np.ndarray, y: np.ndarray) -> np.ndarray:
        s = self.screen
        rays = np.stack([(x - s.centre_px[0]) / s.focal_px, (y - s.centre_px[1]) / s.focal_px, np.ones_like(x)], 1)
        hit = self.rays.intersects_first(np.zeros_like(rays), rays)
        out = np.zeros(len(x))
        on = hit >= 0
        a, b, c = (self.points[self.faces[hit[on], k]] for k in range(3))
        d = rays[on]
        normal = np.cross(b - a, c - a)
        facing = np.einsum("ij,ij->i", normal, d)
        at = d * (np.einsum("ij,ij->i", normal, a) / facing)[:, None]
        area2 = np.einsum("ij,ij->i", normal, normal)
        share_b = np.einsum("ij,ij->i", np.cross(at - a, c - a), normal) / area2
        share_c = np.einsum("ij,ij->i", np.cross(b - a, at - a), normal) / area2
        la, lb, lc = (self.radiance[self.shades[hit[on], k]] for k in range(3))
        out[on] = np.where(facing < 0, la + share_b * (lb - la) + share_c * (lc - la), 0)
        return out


def report_time(name: str, scene: Scene, size: tuple[int, int]) -> None:
    """Print the smallest CPU time of a picture."""
    renderer = Renderer(scene.topology, screen_of(scene.case, size))
    light, rate = np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.float32)
    box, taken = Box(), []
    for k in range(25):
        view = scene.view(0.02 * k)
        start = time.process_time()
        box = renderer.draw(view, light, rate, box)
        taken.append(1e3 * (time.process_time() - start))
    print(f"{name:14} {size[0]}x{size[1]}  {min(taken[1:]):6.2f} ms", flush=True)


def report_errors(name: str, scene: Scene, size: tuple[int, int], t_s: float = 0.0) -> None:
    """Print errors of light and rate."""
    screen = screen_of(scene.case, size)
    renderer = Renderer(scene.topology, screen)
    light, rate = np.zeros(size[::-1], np.float32), np.zeros(size[::-1], np.float32)
    renderer.draw(scene.view(t_s), light, rate)
    tracer = Tracer(scene, screen, t_s)
    grown = np.zeros(light.shape, bool)
    grown[1:-1, 1:-1] = (
        sum(light[1 + a : size[1] - 1 + a, 1 + b : size[0] - 1 + b] for a in (-1, 0, 1) for b in (-1, 0, 1)) > 0
    )
    rows, columns = np.nonzero(grown)
    rng = np.random.default_rng(1)
    chosen = rng.choice(len(rows), min(len(rows), 20000), replace=False)
    truth = tracer.light(rows[chosen], columns[chosen], 16)
    mean = truth[truth > 0].mean()
    error = 100 * np.abs(light[rows[chosen], columns[chosen]] - truth) / mean
    print(f"{name:14} light  " + _figures(error))
    worst = np.argsort(-error)[:500]
    finer = tracer.light(rows[chosen][worst], columns[chosen][worst], 64)
    error = 100 * np.abs(light[rows[chosen][worst], columns[chosen][worst]] - finer) / mean
    print(f"{name:14} 500 worst against 64 x 64  " + _figures(error))
    fastest = np.abs(rate).max() / mean
    dt = 0.1 / max(np.abs(scene.case.spin_rad_s) * screen.focal_px * 0.03, fastest)
    near = [np.zeros_like(light), np.zeros_like(light)]
    for out, sign in zip(near, (-1, 1), strict=True):
        renderer.draw(scene.view(t_s + 0.05 * sign * dt), out, np.zeros_like(light))
    slope = (near[1].astype(float) - near[0]) / (0.1 * dt)
    scale = np.sqrt((slope[grown] ** 2).mean())
    error = 100 * np.abs(rate - slope)[grown]
    print(f"{name:14} rate against its light's differences, % of rms  " + _figures(error / scale))
    edge = np.abs(rate) > 3 * np.median(np.abs(rate[grown]))
    moving = rng.choice(np.flatnonzero(edge), min(edge.sum(), 800), replace=False)
    r, c = np.unravel_index(moving, light.shape)
    after, prior = (Tracer(scene, screen, t_s + s * dt).light(r, c, 64) for s in (1, -1))
    slope = (after - prior) / (2 * dt)
    error = 100 * np.abs(rate[r, c] - slope) / np.sqrt((slope**2).mean())
    print(f"{name:14} rate of changing pixels against rays, % of rms  " + _figures(error))


def _figures(error: np.ndarray) -> str:
    return "median {:.3f}  p90 {:.3f}  p99 {:.3f}  max {:.2f} %".format(
        *np.percentile(error, [50, 90, 99]), error.max()
    )


@app.command
def shapes(*names: str, check: bool = False) -> None:
    """Print the CPU milliseconds of a picture of the shipped shapes with its rate (smallest of many) at two sizes.

    The surfaces are those of the rigs of the same NAMES, with the craters, boulders, albedo and cells that these make
    at 346 x 260 pixels. With --check (needs embreex) light is compared with 16 x 16 rays a pixel and rates with
    differences of 64 x 64 rays in some pixels, in per cent of the mean of what the body lights.
    """
    for name in names or CASES:
        scene = Scene(name)
        for size in SIZES:
            report_time(name, scene, size)
        if check:
            report_errors(name, scene, SIZES[0])


FIELD_DEG = 60.0
TIMES_S = (20, 45, 70)
SAMPLES = 8


@app.command
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
    motion, rate = camera_motion(t_s * 10**9, scene.camera_path, scene.path_time), np.zeros_like(light)
    spent_s = []
    for _ in range(9):
        start_s = time.process_time()
        scene._shade(motion, light, rate, with_rate=with_rate)
        spent_s.append(time.process_time() - start_s)
    return min(spent_s) / light.size * 1e9


def errors(parameters, pinhole, t_s: int, light: np.ndarray) -> str:
    truth = np.zeros_like(light)
    with SampledTerrain(parameters, pinhole, SAMPLES) as sampled:
        sampled.light(t_s * 10**9, truth)
    off = np.abs(light - truth) / truth.mean() * 100
    return f"; error: median {np.median(off):.3f}, p99 {np.percentile(off, 99):.1f}, mean {off.mean():.3f} %"


if __name__ == "__main__":
    app()
