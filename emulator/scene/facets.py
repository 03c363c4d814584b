"""A mesh on a stage: lit by the Sun by its law of reflection, with shadows.

The vertex shader finds the cosines of incidence and emission and the phase angle, and they are interpolated over a
facet, so normals are, and facets do not show. Phase angles come from atan(|cross|, dot): acos is good to 1.6e-4 rad
only. The fragment gives radiance, W m-2 sr-1:

    L = E_sun r(mu0, mu, g) sunlit + ambient r(mu, mu, 0)

where `ambient` stands for light from all around (earthshine, light from other ground), as if it came from the eye.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflectance import Reflectance
from emulator.scene.culling import Cells, draw
from emulator.scene.mesh import Mesh
from emulator.scene.shadows import SUNLIT_GLSL, ShadowMap

if TYPE_CHECKING:
    import moderngl

__all__ = ["Facets", "Frame"]

_VERTEX = """
#version 430
uniform mat3 camera_from_body;
uniform vec3 place;          // of the body's origin, camera axes, m
uniform vec3 sun;            // towards it, camera axes
uniform vec2 zoom, depth;    // see Stage
uniform mat4 shadow_from_body;
in vec3 position, normal;
out vec3 angles;             // cosines of incidence and emission, phase angle
out vec3 in_shadow_map;
void main() {
    vec3 outward = camera_from_body * normal;
    vec3 ray = camera_from_body * position + place;
    vec3 eye = -normalize(ray);
    angles = vec3(dot(outward, sun), dot(outward, eye), atan(length(cross(sun, eye)), dot(sun, eye)));
    in_shadow_map = (shadow_from_body * vec4(position + normal * %(lift)s, 1.0)).xyz;
    gl_Position = vec4(zoom * ray.xy, depth.x * ray.z + depth.y, ray.z);
}
"""

_FRAGMENT = """
#version 430
uniform float irradiance, ambient;
in vec3 angles;
in vec3 in_shadow_map;
out float radiance;
%(reflectance)s
%(sunlit)s
void main() {
    float lit = reflect_sun(angles.x, angles.y, angles.z);
    if (lit > 0.0) lit *= sunlit(in_shadow_map);
    float around = abs(angles.y);
    radiance = irradiance * lit + ambient * reflect_sun(around, around, 0.0);
}
"""


@dataclass(frozen=True, eq=False)
class Frame:
    """What is the same for all bodies of a picture.

    Attributes
    ----------
    sun : (3,) unit, towards the Sun in camera axes.
    zoom, depth : see `Pinhole.zoom`, `stage.depth_terms`.
    irradiance, ambient : W/m2.
    """

    sun: npt.NDArray[np.float64]
    zoom: tuple[float, float]
    depth: tuple[float, float]
    irradiance: float
    ambient: float


class Facets:
    """One mesh in a context's memory, with its law of reflection."""

    def __init__(self, context: moderngl.Context, mesh: Mesh, law: Reflectance, shadows: ShadowMap | None) -> None:
        self._shadows = shadows
        lift = shadows.lift_m if shadows else 0.0
        self._program = context.program(
            vertex_shader=_VERTEX % {"lift": repr(float(lift))},
            fragment_shader=_FRAGMENT
            % {"reflectance": law.glsl(), "sunlit": SUNLIT_GLSL if shadows else "float sunlit(vec3 s) { return 1.0; }"},
        )
        if shadows:
            self._program["range_m"] = shadows.range_m
        points = np.hstack([mesh.vertices, mesh.normals]).astype(np.float32)
        self._cells = Cells(mesh)
        self._array = context.vertex_array(
            self._program,
            [(context.buffer(points), "3f 3f", "position", "normal")],
            index_buffer=context.buffer(self._cells.faces),
            skip_errors=True,  # a black body's shader has no use for normals
        )
        self._commands = context.buffer(reserve=self._cells.buffer_bytes)

    def render(
        self,
        frame: Frame,
        camera_from_body: npt.NDArray[np.float64],
        place_m: npt.NDArray[np.float64],
        shadow_from_body: npt.NDArray[np.float64],
    ) -> None:
        """Draw; matrices (3, 3) and (4, 4), the body's origin (3,) in camera axes."""
        values = {
            "camera_from_body": tuple(camera_from_body.T.ravel()),  # GL stores columns
            "place": tuple(place_m),
            "sun": tuple(frame.sun),
            "zoom": frame.zoom,
            "depth": frame.depth,
            "irradiance": frame.irradiance,
            "ambient": frame.ambient,
            "shadow_from_body": tuple(shadow_from_body.T.ravel()),
        }
        for name, value in values.items():
            if name in self._program:  # GL drops what a shader does not use
                self._program[name] = value
        if self._shadows:
            self._shadows.use()
        draw(self._array, self._cells.seen_from(-(camera_from_body.T @ place_m)), self._commands)
