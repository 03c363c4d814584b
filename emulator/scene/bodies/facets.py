"""A mesh on a stage: lit by the Sun by its law of reflection, with shadows.

The vertex shader finds the cosines of incidence and emission, and what depends on the phase angle alone; they are
interpolated over a facet, so normals are, and facets do not show. Phase angles come from atan(|cross|, dot): acos is
good to 1.6e-4 rad only. The fragment gives radiance, W m-2 sr-1:

    L = E_sun r(mu0, mu, g) sunlit + ambient r(mu, mu, 0)

where `ambient` stands for light from all around (earthshine, light from other ground), as if it came from the eye.

The shadow map is asked at the vertices where facets are about as small as its texels or as pixels, and their answers
interpolated, which is as sharp and costs a fraction; for larger facets it is asked at every fragment.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.photometry.reflectance import Reflectance
from emulator.scene.bodies.culling import Cells, draw
from emulator.scene.bodies.mesh import Mesh
from emulator.scene.bodies.shadows import SUNLIT_GLSL, ShadowMap

if TYPE_CHECKING:
    import moderngl

__all__ = ["Facets", "Frame"]

_VERTEX = """
#version 430
uniform mat3 camera_from_body;
uniform vec3 place;          // of the body's origin, camera axes, m
uniform vec3 sun;            // towards it, camera axes
uniform vec2 zoom;           // see Pinhole
uniform vec2 depth;          // terms for depths from the body's origin, so that a long range cancels nothing
uniform mat4 shadow_from_body;
in vec3 position, normal;
in float albedo;             // relative to the law of reflection
out float tint;
out vec4 angles;             // cosines of incidence and emission, terms of the phase angle
out vec3 in_shadow_map;      // or the share of the Sun, in x
%(reflectance)s
%(sunlit)s
void main() {
    vec3 outward = camera_from_body * normal;
    vec3 from_origin = camera_from_body * position;
    vec3 ray = from_origin + place;
    vec3 eye = -normalize(ray);
    float phase = atan(length(cross(sun, eye)), dot(sun, eye));
    angles = vec4(dot(outward, sun), dot(outward, eye), phase_terms(phase));
    in_shadow_map = (shadow_from_body * vec4(position + normal * %(lift)s, 1.0)).xyz;
    %(answer)s
    tint = albedo;
    gl_Position = vec4(zoom * ray.xy, depth.x * from_origin.z + depth.y, ray.z);
}
"""

_FRAGMENT = """
#version 430
uniform float irradiance, ambient;
in vec4 angles;
in vec3 in_shadow_map;
in float tint;
out float radiance;
%(reflectance)s
%(sunlit)s
void main() {
    float lit = reflect_at(angles.x, angles.y, angles.zw);
    if (lit > 0.0) lit *= %(share)s;
    radiance = irradiance * lit;
    if (ambient > 0.0) {
        float around = abs(angles.y);
        radiance += ambient * reflect_sun(around, around, 0.0);
    }
    radiance *= tint;
}
"""

# Where the shadow map is asked: nowhere, at vertices, at fragments.
_NOWHERE = {"vertex": "", "answer": "", "fragment": "", "share": "1.0"}
_AT_VERTICES = {
    "vertex": SUNLIT_GLSL,
    "answer": "in_shadow_map.x = sunlit(in_shadow_map);",
    "fragment": "",
    "share": "in_shadow_map.x",
}
_AT_FRAGMENTS = {"vertex": "", "answer": "", "fragment": SUNLIT_GLSL, "share": "sunlit(in_shadow_map)"}


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
    """One mesh in a context's memory, with its law of reflection.

    Parameters
    ----------
    shadows : the map to ask; None for no shadows.
    at_vertices : whether it is asked at the vertices only.
    """

    def __init__(
        self,
        context: moderngl.Context,
        mesh: Mesh,
        law: Reflectance,
        shadows: ShadowMap | None,
        *,
        at_vertices: bool = False,
    ) -> None:
        self._shadows = shadows
        asked = _NOWHERE if shadows is None else _AT_VERTICES if at_vertices else _AT_FRAGMENTS
        lift = repr(float(shadows.lift_m if shadows else 0.0))
        law_text, answer, share = law.glsl(), asked["answer"], asked["share"]
        self._program = context.program(
            vertex_shader=_VERTEX
            % {"reflectance": law_text, "sunlit": asked["vertex"], "lift": lift, "answer": answer},
            fragment_shader=_FRAGMENT % {"reflectance": law_text, "sunlit": asked["fragment"], "share": share},
        )
        if shadows:
            self._program["range_m"] = shadows.range_m
        points = np.hstack([mesh.vertices, mesh.normals, mesh.vertex_albedo[:, None]]).astype(np.float32)
        self._cells = Cells(mesh)
        self._array = context.vertex_array(
            self._program,
            [(context.buffer(points), "3f 3f 1f", "position", "normal", "albedo")],
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
        a, b = frame.depth
        values = {
            "camera_from_body": tuple(camera_from_body.T.ravel()),  # GL stores columns
            "place": tuple(place_m),
            "sun": tuple(frame.sun),
            "zoom": frame.zoom,
            "depth": (a, a * place_m[2] + b),
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
