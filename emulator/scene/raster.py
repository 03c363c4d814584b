"""A mesh drawn by GL into a picture of light, on a `Stage`.

Lommel-Seeliger needs mu0 / (mu0 + mu), which does not change when the normal gets longer or shorter. So the two
cosines are computed at the vertices and interpolated, which is the same as interpolating the normal and costs the
fragments one division.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from emulator.scene.base import Light
from emulator.scene.mesh import Mesh
from emulator.scene.stage import Rectangle, Stage

if TYPE_CHECKING:
    import moderngl

__all__ = ["Raster", "View"]

_VERTEX = """
#version 430
uniform mat3 camera_from_body;
uniform vec3 sun;        // to the Sun, camera axes
uniform float range;     // to the body's centre, body radii
uniform vec2 zoom;       // focal length over half the picture
in vec3 position;        // body radii
in vec3 normal;
out vec2 cosines;        // of incidence and of emission
void main() {
    vec3 from_centre = camera_from_body * position;
    vec3 outward = camera_from_body * normal;
    vec3 ray = from_centre + vec3(0.0, 0.0, range);
    cosines = vec2(dot(outward, sun), -dot(outward, normalize(ray)));
    // near and far planes one radius before and behind the centre; written so that a long range cancels nothing
    gl_Position = vec4(zoom * ray.xy, range * from_centre.z + 1.0, ray.z);
}
"""

_FRAGMENT = """
#version 430
uniform float full;      // light where both cosines are equal, times two
in vec2 cosines;
out float light;
void main() {
    float lit = max(cosines.x, 0.0);
    // at the limb an interpolated normal can lean away from the eye: by a little, and it counts as that little
    light = full * lit / max(lit + abs(cosines.y), 1e-20);
}
"""


@dataclass(frozen=True)
class View:
    """How the mesh is seen and lit.

    Attributes
    ----------
    camera_from_body : (3, 3) rotation.
    sun : (3,) unit, towards the Sun in camera axes.
    range_radii : distance of the body's origin, on the boresight, in radii of the mesh; > 1.
    zoom : focal length over half the picture's width and height.
    full : twice the light of a facet seen and lit under equal angles.
    """

    camera_from_body: npt.NDArray[np.float64]
    sun: npt.NDArray[np.float64]
    range_radii: float
    zoom: tuple[float, float]
    full: float


class Raster:
    """Draws `mesh` into pictures of `size` = (width, height), `samples` x `samples` a pixel, inside `reach` only."""

    def __init__(self, mesh: Mesh, size: tuple[int, int], samples: int, reach: Rectangle) -> None:
        self._stage = Stage(size, samples, reach)
        self.renderer = self._stage.renderer
        gl = self._stage.context
        with gl:
            self._shading = gl.program(vertex_shader=_VERTEX, fragment_shader=_FRAGMENT)
            points = np.hstack([mesh.vertices / mesh.radius_m, mesh.normals]).astype(np.float32)
            self._facets = gl.vertex_array(
                self._shading,
                [(gl.buffer(points), "3f 3f", "position", "normal")],
                index_buffer=gl.buffer(np.ascontiguousarray(mesh.faces)),
            )

    def close(self) -> None:
        """Release the context and what lives in it; a second call does nothing."""
        self._stage.close()

    def draw(self, views: Sequence[View], outs: Sequence[Light]) -> None:
        """Write the light of each view into its picture, (height, width) float32."""
        self._stage.draw_all([partial(self._stage.begin, partial(self._render, view)) for view in views], outs)

    def _render(self, view: View, _: moderngl.Context) -> None:
        shading = self._shading
        shading["camera_from_body"] = tuple(view.camera_from_body.T.ravel())  # GL stores columns
        shading["sun"], shading["zoom"] = tuple(view.sun), view.zoom
        shading["range"], shading["full"] = view.range_radii, view.full
        self._facets.render()
