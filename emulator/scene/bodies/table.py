"""Rig tables of bodies in sunlight, and of the detail that is added to a body's shape model."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from msgspec import Meta

from emulator.photometry.reflectance import LommelSeeliger, Reflectance, Sun
from emulator.scene.kind import SceneKind
from emulator.tables.typed_table import NO_FILE, RigFile, Seed, TimeScale
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters
from firmware_protocol.bounds import Bounded, Share, check_bounds


@dataclass(frozen=True)
class Bare:
    """Nothing: the shape model as it is."""

    kind: ClassVar[str] = "none"


@dataclass(frozen=True)
class Regolith(Bounded):
    """Ground of an asteroid: boulders and craters that the shape model does not have, roughness and albedo.

    All of it is fixed to the body and the same for a seed. Boulders and craters are made where the shape model is too
    coarse for them, down to the resolution of the camera at its closest; the smallest ones fade in near this limit.

    Attributes
    ----------
    seed : seed of all random numbers.
    boulders_km2 : boulders larger than 5 m on a square kilometre; 0: none. 949 on Itokawa (Michikami et al. 2008).
    boulder_power : their number goes with this power of their size: -3.1 on Itokawa.
    craters
        N(> D) D^2, craters larger than D per m2 times D^2: 0.046 where they are 3 % of geometric saturation; 0: none.
    crater_depth : depth over diameter of a fresh crater; old ones are shallower, to a quarter of it.
    slope_deg : root mean square slope that roughness adds to facets of rough ground; grain below them continues it.
    albedo_rms : root mean square variation of albedo, relative; its mean is that of the body's reflectance.
    smooth_share
        Share of the surface, low by its gravity and even, without boulders and nearly without roughness and
        variation of albedo: 0.2 on Itokawa; 0: none, and roughness comes in patches.
    smallest_m : boulders and craters are not smaller.
    facet_px : facets made here are not smaller than about this, pixels at the camera's closest.
    most_facets
        Only as many boulders and craters are made, the largest first, as make about so many facets of the body.
    """

    kind: ClassVar[str] = "regolith"
    seed: Seed = 1
    boulders_km2: Annotated[float, Meta(ge=0, le=1e6)] = 949.0
    boulder_power: Annotated[float, Meta(ge=-5, le=-1)] = -3.1
    craters: Annotated[float, Meta(ge=0, le=0.3)] = 0.01
    crater_depth: Annotated[float, Meta(ge=0.01, le=0.3)] = 0.12
    slope_deg: Annotated[float, Meta(ge=0, le=20)] = 6.0
    albedo_rms: Annotated[float, Meta(ge=0, le=0.5)] = 0.08
    smooth_share: Annotated[float, Meta(ge=0, le=0.9)] = 0.0
    smallest_m: Annotated[float, Meta(ge=1e-3, le=1e6)] = 0.5
    facet_px: Annotated[float, Meta(ge=0.5, le=100)] = 3.0
    most_facets: Annotated[int, Meta(ge=100, le=2_000_000)] = 100_000


@dataclass(frozen=True)
class Clouds(Bounded):
    """A planet like the Earth: the shape made round, with oceans, land, and clouds in belts about its +z axis.

    Attributes
    ----------
    seed : seed of continents and clouds.
    cloud_cover : share of the surface under clouds, about.
    wind_m_s : wind over the oceans: the glint of the Sun on their waves is wider and fainter with more.
    facet_px : facets are made about this large, pixels at the camera's closest.
    """

    kind: ClassVar[str] = "clouds"
    seed: Seed = 1
    cloud_cover: Share = 0.6
    wind_m_s: Annotated[float, Meta(ge=0, le=15)] = 7.0
    facet_px: Annotated[float, Meta(ge=1, le=1000)] = 8.0


Detail = Bare | Regolith | Clouds
"""Any of them, as the type of a key in a rig's table."""


@dataclass(frozen=True)
class BodyTable:
    """One body.

    Attributes
    ----------
    name : name by which other bodies refer to it in `fixed_to`.
    shape
        A file, or the name of a shipped model: 'eros007790', 'eros022540', 'itokawa_49152'; a part of the
        rendezvous target, 'target_bus', 'target_panel', 'target_ring', 'target_plate', 'target_marks'; 'globe',
        of radius 1. Each node with a mesh of a glTF or USD file becomes a body.
    units_m : the shape's unit of length in metres; 1000 for kilometres.
    path : its path, in the world or in the frame of `fixed_to`.
    fixed_to : name of the body that it is fixed to; empty: the world.
    reflectance : its law of reflection.
    detail : detail that is added to the shape model.
    smooth
        True: normals are interpolated over facets, as for ground; false: each facet is flat, as for foil and boxes.
    throws_shadow : True: it casts shadows on itself and on others.
    animation : name of the one animation of a glTF file that moves its nodes; empty: all of them.
    repeat : True: the animation begins again at its end.
    """

    name: str = ""
    shape: RigFile = NO_FILE
    units_m: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    path: TrajectoryParameters = field(default_factory=FixedPath)
    fixed_to: str = ""
    reflectance: Reflectance = field(default_factory=LommelSeeliger)
    detail: Detail = field(default_factory=Bare)
    smooth: bool = True
    throws_shadow: bool = True
    animation: str = ""
    repeat: bool = False

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.shape:
            raise ValueError("shape is missing: name a file or a shipped model")


@dataclass(frozen=True)
class BodiesParameters:
    """Bodies in sunlight, seen from a camera on its path.

    Attributes
    ----------
    camera : the camera's path in the world.
    sun : direction and distance of the Sun.
    ambient_w_m2 : light from all around, W/m2: earthshine, 0.06 on the Moon under a full Earth.
    samples : with run.painter = "gl", light is averaged over samples x samples points of each pixel, 1 to 8.
    detail_px : facets smaller than this are merged into larger ones, pixels; 0 keeps every facet.
    shadows : True: bodies cast shadows.
    time_scale : speed of all motion relative to reality.
    bodies : the bodies.
    """

    kind: ClassVar[str] = "bodies"
    camera: TrajectoryParameters = field(default_factory=FixedPath)
    sun: Sun = field(default_factory=Sun)
    ambient_w_m2: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    samples: Annotated[int, Meta(ge=1, le=8)] = 8
    detail_px: Annotated[float, Meta(ge=0, le=100)] = 0.5
    shadows: bool = True
    time_scale: TimeScale = 1.0
    bodies: tuple[BodyTable, ...] = ()

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.bodies:
            raise ValueError("bodies is empty: a [[scene.bodies]] table is needed for each body")
        for k, body in enumerate(self.bodies):
            if body.fixed_to and body.fixed_to not in {earlier.name for earlier in self.bodies[:k]}:
                raise ValueError(
                    f"bodies: {body.fixed_to!r}, to which one is fixed, must be the name of an earlier one"
                )


BODIES = SceneKind(
    BodiesParameters,
    "emulator.scene.bodies.raster_bodies:RasterBodies",
    lens="applied",
    gl="emulator.scene.bodies.gl_bodies:GlBodies",
    threads=True,
)
