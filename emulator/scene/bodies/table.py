"""Rig tables of bodies in sunlight, and of the detail that is added to a body's shape model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from emulator.photometry.reflectance import LommelSeeliger, Reflectance, Sun
from emulator.scene.kind import SceneKind
from emulator.tables.typed_table import NO_FILE, RigFile
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters

__all__ = ["BODIES", "Bare", "BodiesParameters", "BodyTable", "Clouds", "Detail", "Regolith"]


def _require(owner: object, name: str, low: float, high: float) -> None:
    value = getattr(owner, name)
    if not low <= value <= high:
        raise ValueError(f"{name} is {value:g}: it must be {low:g} to {high:g}")


@dataclass(frozen=True)
class Bare:
    """Nothing: the shape model as it is."""

    kind: ClassVar[str] = "none"


@dataclass(frozen=True)
class Regolith:
    """Ground of an asteroid: boulders and craters that the shape model does not have, roughness and albedo.

    All of it is fixed to the body and the same for a seed. Boulders and craters are made where the shape model is too
    coarse for them, down to the resolution of the camera at its closest; the smallest ones fade in near this limit.

    Attributes
    ----------
    seed
        Seed of all random numbers.
    boulders_km2
        Boulders larger than 5 m on a square kilometre; 0: none. 949 on Itokawa (Michikami et al. 2008).
    boulder_power
        Their number goes with this power of their size: -3.1 on Itokawa.
    craters
        N(> D) D^2, craters larger than D per m2 times D^2: 0.046 where they are 3 % of geometric saturation; 0: none.
    crater_depth
        Depth over diameter of a fresh crater; old ones are shallower, to a quarter of it.
    slope_deg
        Root mean square slope that roughness adds to facets of rough ground.
    albedo_rms
        Root mean square variation of albedo, relative; its mean is that of the body's reflectance.
    smooth_share
        Share of the surface that is low by its gravity and even in the shape model: it has no boulders and nearly no
        roughness or variation of albedo. 0.2 on Itokawa; 0: none, and roughness comes in patches.
    smallest_m
        Boulders and craters are not smaller.
    facet_px
        Facets made here are not smaller than about this, pixels at the camera's closest.
    most_facets
        Only as many boulders and craters are made, the largest first, as make about so many facets of the body.
    """

    kind: ClassVar[str] = "regolith"
    seed: int = 1
    boulders_km2: float = 949.0
    boulder_power: float = -3.1
    craters: float = 0.01
    crater_depth: float = 0.12
    slope_deg: float = 6.0
    albedo_rms: float = 0.08
    smooth_share: float = 0.0
    smallest_m: float = 0.5
    facet_px: float = 3.0
    most_facets: int = 100_000

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"seed is {self.seed}: it must be 0 to 2^63 - 1")
        _require(self, "boulders_km2", 0, 1e6)
        _require(self, "boulder_power", -5, -1)
        _require(self, "craters", 0, 0.3)
        _require(self, "crater_depth", 0.01, 0.3)
        _require(self, "slope_deg", 0, 20)
        _require(self, "albedo_rms", 0, 0.5)
        _require(self, "smooth_share", 0, 0.9)
        _require(self, "smallest_m", 1e-3, 1e6)
        _require(self, "facet_px", 0.5, 100)
        _require(self, "most_facets", 100, 2_000_000)


@dataclass(frozen=True)
class Clouds:
    """A planet like the Earth: the shape made round, with oceans, land, and clouds in belts about its +z axis.

    Attributes
    ----------
    seed
        Seed of continents and clouds.
    cloud_cover
        Share of the surface under clouds, about.
    facet_px
        Facets are made about this large, pixels at the camera's closest.
    """

    kind: ClassVar[str] = "clouds"
    seed: int = 1
    cloud_cover: float = 0.6
    facet_px: float = 8.0

    def __post_init__(self) -> None:
        if not 0 <= self.seed < 1 << 63:
            raise ValueError(f"seed is {self.seed}: it must be 0 to 2^63 - 1")
        _require(self, "cloud_cover", 0, 1)
        _require(self, "facet_px", 1, 1000)


Detail = Bare | Regolith | Clouds
"""Any of them, as the type of a key in a rig's table."""


@dataclass(frozen=True)
class BodyTable:
    """One body.

    Attributes
    ----------
    name
        Name by which other bodies refer to it in `fixed_to`.
    shape
        A file, or the name of a shipped model: 'eros007790', 'eros022540', 'itokawa_49152', or a part of the
        rendezvous target: 'target_bus', 'target_panel', 'target_ring', 'target_plate', 'target_marks';
        or 'globe', a ball of radius 1. Each node with a mesh of a glTF or USD file becomes a
        body.
    units_m
        The shape's unit of length in metres; 1000 for kilometres.
    path
        Its path, in the world or in the frame of `fixed_to`.
    fixed_to
        Name of the body that it is fixed to; empty: the world.
    reflectance
        Its law of reflection.
    detail
        Detail that is added to the shape model.
    smooth
        True: normals are interpolated over facets, as for ground; false: each facet is flat, as for foil and boxes.
    throws_shadow
        True: it casts shadows on itself and on others.
    animation
        Name of the one animation of a glTF file that moves its nodes; empty: all of them.
    repeat
        True: the animation begins again at its end.
    """

    name: str = ""
    shape: RigFile = NO_FILE
    units_m: float = 1.0
    path: TrajectoryParameters = field(default_factory=FixedPath)
    fixed_to: str = ""
    reflectance: Reflectance = field(default_factory=LommelSeeliger)
    detail: Detail = field(default_factory=Bare)
    smooth: bool = True
    throws_shadow: bool = True
    animation: str = ""
    repeat: bool = False

    def __post_init__(self) -> None:
        if not self.shape:
            raise ValueError("shape is missing: name a file or a shipped model")
        if not 0 < self.units_m <= 1e9:
            raise ValueError(f"units_m is {self.units_m:g}: it must be above 0 and at most 1e9")


@dataclass(frozen=True)
class BodiesParameters:
    """Bodies in sunlight, seen from a camera on its path.

    Attributes
    ----------
    camera
        The camera's path in the world.
    sun
        Direction and distance of the Sun.
    ambient_w_m2
        Light from all around, W/m2: earthshine, 0.06 on the Moon under a full Earth.
    samples
        With run.painter = "gl", light is averaged over samples x samples points of each pixel, 1 to 4.
    detail_px
        Facets smaller than this are merged into larger ones, pixels; 0 keeps every facet.
    shadows
        True: bodies cast shadows.
    time_scale
        Speed of all motion relative to reality.
    bodies
        The bodies.
    """

    kind: ClassVar[str] = "bodies"
    camera: TrajectoryParameters = field(default_factory=FixedPath)
    sun: Sun = field(default_factory=Sun)
    ambient_w_m2: float = 0.0
    samples: int = 2
    detail_px: float = 0.5
    shadows: bool = True
    time_scale: float = 1.0
    bodies: tuple[BodyTable, ...] = ()

    def __post_init__(self) -> None:
        if not 0 <= self.ambient_w_m2 <= 1e6:
            raise ValueError(f"ambient_w_m2 is {self.ambient_w_m2}: it must be 0 to 1e6")
        if self.samples not in (1, 2, 3, 4):
            raise ValueError(f"samples is {self.samples}: it must be 1, 2, 3 or 4")
        if not 0 <= self.detail_px <= 100:
            raise ValueError(f"detail_px is {self.detail_px}: it must be 0 to 100")
        if not 0 < self.time_scale <= 1e6:
            raise ValueError(f"time_scale is {self.time_scale}: it must be above 0 and at most 1e6")
        if not self.bodies:
            raise ValueError("bodies is empty: a [[scene.bodies]] table is needed for each body")
        self._require_order()

    def _require_order(self) -> None:
        names: list[str] = []
        for body in self.bodies:
            if body.fixed_to and body.fixed_to not in names:
                raise ValueError(
                    f"bodies: {body.fixed_to!r}, to which one is fixed, must be the name of an earlier one"
                )
            names.append(body.name)


BODIES = SceneKind(
    BodiesParameters,
    "emulator.scene.bodies.raster_bodies:build_bodies",
    lens="applied",
    gl="emulator.scene.bodies.gl_bodies:GlBodies",
    threads=True,
)
