"""Mitsuba 3 as the renderer of an emulated camera: a rough asteroid that the orbit in the rig goes around.

    pip install mitsuba numpy                   evstim itself is needed for one file, evstim/renderer.py
    evstim run orbit.toml                       in one terminal
    python orbit_mitsuba.py                     in another one

Each request has the pose of the camera on the path in the rig. Mitsuba traces rays, so light is float32 radiance, and
it gives the position of each visible point. The asteroid stands still, so the motion of a pixel is the change of its
point's projection from the pose of the last request to the present one.
"""

from __future__ import annotations

import sys

import mitsuba as mi
import numpy as np

from evstim.renderer import Camera, Image, Images, Pose, Renderer

SUN_W_M2 = 1361.0
ALBEDO = 0.15
SAMPLES = 16
WHITE_W_M2_SR = 30.0  # as scene.white_w_m2_sr in orbit.toml


def rotation(q: tuple[float, ...]) -> np.ndarray:
    """Return the matrix of a unit quaternion, scalar first."""
    w, x, y, z = q
    return np.array([
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ])  # fmt: skip


def asteroid(rings: int = 96, seed: int = 1) -> mi.Mesh:
    """Return a rough body with radii of some 200 m."""
    chance = np.random.default_rng(seed)
    u, v = np.meshgrid(np.linspace(0, np.pi, rings), np.linspace(0, 2 * np.pi, 2 * rings))
    away = np.stack((np.sin(u) * np.cos(v), np.sin(u) * np.sin(v), np.cos(u)), axis=2).reshape(-1, 3)
    radius = np.full(len(away), 200.0)
    for octave in range(1, 6):
        waves = chance.normal(size=(24, 3)) * 2.0**octave
        radius += 12.0 * 0.55**octave * np.cos(away @ waves.T + chance.uniform(0, 6.3, 24)).sum(axis=1) / 2
    columns = u.shape[1]
    first = (np.arange(2 * rings - 1)[:, None] * columns + np.arange(columns - 1)).reshape(-1, 1)
    faces = np.concatenate([first + [0, columns, 1], first + [columns, columns + 1, 1]])
    surface = mi.Properties()
    surface["bsdf"] = mi.load_dict({"type": "twosided", "bsdf": {"type": "diffuse", "reflectance": ALBEDO}})
    shape = mi.Mesh("asteroid", len(away), len(faces), props=surface)
    values = mi.traverse(shape)
    values["vertex_positions"] = (away * radius[:, None] * [1.3, 1.0, 0.9]).astype(np.float32).reshape(-1)
    values["faces"] = faces.astype(np.uint32).reshape(-1)
    values.update()
    return shape


class Orbit:
    """The asteroid and the Sun, drawn for a camera of evstim's."""

    def __init__(self, camera: Camera) -> None:
        self.camera = camera
        self.last: tuple[int, Pose] | None = None
        film = {"type": "hdrfilm", "width": camera.width, "height": camera.height, "rfilter": {"type": "box"},
                "pixel_format": "luminance", "component_format": "float32"}  # fmt: skip
        sensor = {"type": "perspective", "fov_axis": "y", "fov": camera.vertical_field_deg, "near_clip": 1.0,
                  "film": film, "sampler": {"type": "stratified", "sample_count": SAMPLES}}  # fmt: skip
        self.scene = mi.load_dict({
            "type": "scene", "asteroid": asteroid(), "sensor": sensor,
            "sun": {"type": "directional", "direction": [-1, 0.4, -0.2], "irradiance": SUN_W_M2},
            "integrator": {"type": "aov", "aovs": "place:position,seen:shape_index", "light": {"type": "direct"}},
        })  # fmt: skip
        self.values = mi.traverse(self.scene)

    def draw(self, image: Image) -> None:
        """Fill an image, seen from its pose."""
        to_world = np.eye(4)
        to_world[:3, :3] = rotation(image.pose.q_world_from_camera) * [-1, -1, 1]  # Mitsuba: x left, y up, z ahead
        to_world[:3, 3] = image.pose.position_m
        self.values["sensor.to_world"] = mi.ScalarTransform4f(to_world)
        self.values.update()
        drawn = np.array(mi.render(self.scene))
        image.light[:] = np.maximum(drawn[..., 0], 0) / WHITE_W_M2_SR
        covered = drawn[..., 4:]  # share of the samples that hit; the place is the sum over these, over all samples
        place_m = np.divide(drawn[..., 1:4], covered, where=covered > 0, out=np.zeros_like(drawn[..., 1:4]))
        image.motion[:] = np.where(covered > 0, self.motion(image, place_m), 0.0)

    def motion(self, image: Image, place_m: np.ndarray) -> np.ndarray:
        """Return the motion of the points at `place_m`, (height, width, 3), px/s; 0 at the start."""
        last, self.last = self.last, (image.t_ns, image.pose)
        if last is None or last[0] >= image.t_ns:
            return np.zeros((*place_m.shape[:2], 2))
        now, before = self.projected(place_m, image.pose), self.projected(place_m, last[1])
        return (now - before) / ((image.t_ns - last[0]) * 1e-9)

    def projected(self, place_m: np.ndarray, pose: Pose) -> np.ndarray:
        """Return columns and rows of places seen from a pose."""
        local = (place_m - pose.position_m) @ rotation(pose.q_world_from_camera)
        return self.camera.focal_px * local[..., :2] / local[..., 2:]


def main(address: str) -> None:
    """Draw what evstim requests, until it ends."""
    mi.set_variant("scalar_rgb")
    with Renderer(address, Images(motion=True), name=f"Mitsuba {mi.__version__}", wait_s=600) as renderer:
        scene = Orbit(renderer.camera)
        for image in renderer:
            scene.draw(image)
            image.send()


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "127.0.0.1:5560")
