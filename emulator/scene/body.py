"""A body in sunlight, turning about its pole: shape from a mesh, drawn by GL.

Frames: the body's own, +Z along its spin pole, about which it turns right-handed; the world, metres, its origin in the
body's; the camera, x right, y down, z along the boresight. The camera looks at the body's origin from `range_m`, so
with `q_world_from_camera` at its default the world's axes are the camera's: a pole (0, -1, 0) points up in the
picture and a Sun at (0, 0, -1) stands behind the camera.

Light leaves the surface by the law of Lommel and Seeliger,

    r = (w / 4 pi) f(g) mu0 / (mu0 + mu),

with the cosines mu0 of incidence and mu of emission, and Henyey-Greenstein for f, here scaled to f(0) = 1:

    f(g) = ((1 + b)^2 / (1 + 2 b cos g + b^2))^(3/2),    b < 0: light is thrown back

The default b = -0.25 is Eros' (Li 2005; the opposition surge is left out). g is taken at the body's origin. Seen from
the Sun such a body is a disc of even light, pi r / (geometric albedo) = 1: `light_at_zero_phase` is the light of that
disc, relative to the sensor's reference level. So light = light_at_zero_phase * 2 f(g) mu0 / (mu0 + mu).

Left out: shadows that one part casts on another (only the night side is dark), the Sun's width, light from the
surface onto itself. Normals are interpolated between vertices, so facets do not show. A body of a pixel or
so would fall between the samples: it is refused.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np

from emulator.rig_files import RigFile
from emulator.scene.attitude import matrix_of, spin, unit
from emulator.scene.base import Light, Scene, SceneError
from emulator.scene.cycle import Cycle
from emulator.scene.mesh import Mesh, find_shape, load_mesh
from emulator.scene.raster import Raster, View
from emulator.scene.stage import Rectangle

__all__ = ["Body", "BodyParameters", "henyey_greenstein"]

_EROS = RigFile("eros022540")
_SMALLEST_PX = 2.0
_CLOSEST = 1.001  # body radii: the nearest vertex needs some room before the eye


@dataclass(frozen=True)
class BodyParameters:
    """A spinning body and how it is seen.

    Attributes
    ----------
    shape
        A file, or the name of a shipped model: 'eros022540', 'eros007790'.
    units_m
        The shape's unit of length in metres; 1000 for kilometres.
    spin_deg_s
        Rate of its turning about the pole, right-handed; 0 stands still. The default is Eros' own, a turn in 18 972 s.
    start_deg
        How far it has turned at t = 0; 0 has the body's +X axis along z cross pole (see `attitude.spin`).
    pole
        The body's +Z axis in the world; need not be of unit length.
    sun
        Towards the Sun in the world; need not be of unit length.
    q_world_from_camera
        The camera's attitude, scalar first.
    range_m
        Camera to the body's origin; the camera must be outside the body.
    field_of_view_deg
        Of the picture's width, edge to edge.
    samples
        Light is averaged over samples x samples points of each pixel, 1 to 4.
    light_at_zero_phase
        Light of the full disc relative to the sensor's reference level.
    asymmetry
        b of the phase function above, -1 < b < 1.
    """

    shape: RigFile = _EROS
    units_m: float = 1000.0
    spin_deg_s: float = 360.0 / 18_972.0
    start_deg: float = 0.0
    pole: tuple[float, float, float] = (0.0, -1.0, 0.0)
    sun: tuple[float, float, float] = (-0.8, -0.2, -0.6)
    q_world_from_camera: tuple[float, float, float, float] = (1.0, 0.0, 0.0, 0.0)
    range_m: float = 100_000.0
    field_of_view_deg: float = 25.0
    samples: int = 2
    light_at_zero_phase: float = 1.0
    asymmetry: float = -0.25

    def __post_init__(self) -> None:
        for name, value in vars(self).items():
            if name != "shape" and not np.isfinite(value).all():
                raise ValueError(f"{name} is {value}: it must be finite")
        for name in ("pole", "sun", "q_world_from_camera"):
            if not any(getattr(self, name)):
                raise ValueError(f"{name} is all zeros and points nowhere")
        for name in ("units_m", "range_m"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is {getattr(self, name):g}: it must be above 0")
        if not 0 < self.field_of_view_deg < 180:
            raise ValueError(f"field_of_view_deg is {self.field_of_view_deg:g}: it must be between 0 and 180")
        if self.samples not in (1, 2, 3, 4):
            raise ValueError(f"samples is {self.samples}: it must be 1, 2, 3 or 4")
        if not 0 <= self.light_at_zero_phase <= 1e9:
            raise ValueError(f"light_at_zero_phase is {self.light_at_zero_phase:g}: it must be between 0 and 1e9")
        if not -1 < self.asymmetry < 1:
            raise ValueError(f"asymmetry is {self.asymmetry:g}: it must be between -1 and 1")


def henyey_greenstein(phase_rad: float, asymmetry: float) -> float:
    """Return the phase function of the module's first lines, 1 at zero phase."""
    b = asymmetry
    return float(((1 + b) ** 2 / (1 + 2 * b * math.cos(phase_rad) + b * b)) ** 1.5)


class Body(Scene):
    """The body of `parameters` in a picture of `size` = (width, height) pixels.

    `mesh` is drawn instead of the shape that the parameters name, where given.

    Raises
    ------
    SceneError
        The shape cannot be used, the camera is inside it, or there is no GL.
    """

    def __init__(self, parameters: BodyParameters, size: tuple[int, int], mesh: Mesh | None = None) -> None:
        if min(size) < 1:
            raise ValueError(f"size is {size[0]} x {size[1]}: a picture needs at least one pixel")
        self.parameters = p = parameters
        self.mesh = load_mesh(find_shape(p.shape), p.units_m) if mesh is None else mesh
        self._radius_m = self.mesh.radius_m
        _require_outside(p.range_m, self._radius_m)
        self._size = size
        _require_seen(2 * self._radius_m * self.focal_px / p.range_m)
        self._pole = unit(p.pole)
        self._camera_from_world = matrix_of(p.q_world_from_camera).T
        self._turn = Cycle(Fraction(repr(float(p.spin_deg_s))) / 360, Fraction(repr(float(p.start_deg))) / 360)
        self._sun = self._camera_from_world @ unit(p.sun)
        phase_rad = math.acos(min(1.0, max(-1.0, -self._sun[2])))
        self._full = 2.0 * p.light_at_zero_phase * henyey_greenstein(phase_rad, p.asymmetry)
        self._raster = Raster(self.mesh, size, p.samples, self._reach())

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self._size

    @property
    def renderer(self) -> str:
        """The name of what draws, in GL's words."""
        return self._raster.renderer

    @property
    def focal_px(self) -> float:
        """Focal length in pixels."""
        return self._size[0] / 2 / math.tan(math.radians(self.parameters.field_of_view_deg) / 2)

    @property
    def motion_bound_px_s(self) -> float:
        """No point of the surface moves faster in the picture, px/s. (The edge of its night side may.)"""
        p, radius_m = self.parameters, self._radius_m
        arm_m = float(np.hypot(*self.mesh.vertices.T[:2]).max())
        speed_m_s = math.radians(abs(p.spin_deg_s)) * arm_m
        slant = p.range_m / math.sqrt(p.range_m**2 - radius_m**2)  # 1 / cos of the widest angle off the boresight
        return self.focal_px * speed_m_s * slant / (p.range_m - radius_m)

    def light(self, t_ns: int, out: Light) -> None:
        """Write the light at `t_ns` into `out`, (height, width) float32."""
        self.lights((t_ns,), (out,))

    def lights(self, times_ns: Sequence[int], outs: Sequence[Light]) -> None:
        """Write the light at several times into their pictures."""
        self._raster.draw([self._view(self._turn.turns(t_ns)) for t_ns in times_ns], outs)

    def close(self) -> None:
        """Give back the GL context; a second call does nothing."""
        self._raster.close()

    def _view(self, turns: float) -> View:
        zoom = (2 * self.focal_px / self._size[0], 2 * self.focal_px / self._size[1])
        camera_from_body = self._camera_from_world @ spin(self._pole, turns)
        return View(camera_from_body, self._sun, self.parameters.range_m / self._radius_m, zoom, self._full)

    def _reach(self) -> Rectangle:
        """Return the part of the picture that the body meets during a turn: where the cylinder around it stands."""
        along, around = self.mesh.vertices[:, 2], np.hypot(*self.mesh.vertices.T[:2]).max()
        pole = self._camera_from_world @ self._pole
        across = around * np.sqrt(np.maximum(0.0, 1.0 - pole**2))
        ends = np.outer([along.min(), along.max()], pole)
        low, high = ends.min(axis=0) - across, ends.max(axis=0) + across
        depths = np.clip([low[2], high[2]], -self._radius_m, self._radius_m) + self.parameters.range_m
        edges = self.focal_px * np.array([edge[:2] / depth for edge in (low, high) for depth in depths])
        size = np.array(self._size)
        first, last = size / 2 + edges.min(axis=0), size / 2 + edges.max(axis=0)
        left, top = np.maximum(np.floor(first - 1), 0).astype(int)
        right, bottom = np.minimum(np.ceil(last + 1), size).astype(int)
        return Rectangle(int(left), int(top), max(1, int(right - left)), max(1, int(bottom - top)))


def _require_outside(range_m: float, radius_m: float) -> None:
    if range_m <= radius_m * _CLOSEST:
        raise SceneError(
            f"range_m is {range_m:g} and the body reaches {radius_m:g} m from its origin: "
            "the camera would be inside it. Move it out, or look at units_m"
        )


def _require_seen(across_px: float) -> None:
    if across_px < _SMALLEST_PX:
        raise SceneError(
            f"the body is {across_px:.2g} px across and would be lost between samples: "
            f"at least {_SMALLEST_PX:g} px are needed. Lower range_m or field_of_view_deg, or look at units_m"
        )
