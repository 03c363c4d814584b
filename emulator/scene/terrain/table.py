"""Rig tables of ground under a low Sun."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar

from msgspec import Meta

from emulator.photometry.reflectance import EARTHLIGHT_W_M2, LunarLambert, Reflectance
from emulator.scene.kind import SceneKind
from emulator.tables.typed_table import NO_FILE, RigFile, Seed, TimeScale
from emulator.trajectory.parameters import DescentPath, TrajectoryParameters
from firmware_protocol.bounds import check_bounds
from transports.needs import Need, package


@dataclass(frozen=True)
class Ridge:
    """A ridge like Malapert's near the lunar south pole, made by published laws of relief, craters and boulders.

    The map is a nest of square grids of `posts` posts a side, each of half the size and twice the detail of the one
    around it, down to `finest_m`, with the landing site in the middle.

    Attributes
    ----------
    size_m : side of the whole map.
    finest_m : distance of posts around the landing site, to within a factor of two.
    posts : posts a side of each grid: a power of two, 64 to 4096.
    ridge_m : height of the ridge above its base, which is three times as wide: 5000 for Malapert.
    slope_deg : root mean square slope of the relief over 10 m, without craters and ridge.
    crater_density
        N(> D) D^2, craters larger than D per m2 times D^2: 0.046 where they are 3 % of geometric saturation.
    boulder_cover : share of the ground under boulders: k of Golombek and Rapp, 0.01 to 0.05; 0 for none.
    albedo_rms
        Root mean square variation of albedo, relative; the mean is the reflectance's. Above 0 young craters are
        brighter, by up to 0.3.
    seed : seed of the whole map.
    """

    kind: ClassVar[str] = "ridge"
    size_m: Annotated[float, Meta(ge=1, le=600_000)] = 32768.0
    finest_m: Annotated[float, Meta(ge=0.001, le=1000)] = 0.04
    posts: int = 1024
    ridge_m: Annotated[float, Meta(ge=0, le=10_000)] = 5000.0
    slope_deg: Annotated[float, Meta(ge=0, le=30)] = 4.0
    crater_density: Annotated[float, Meta(ge=0, le=0.3)] = 0.046
    boulder_cover: Annotated[float, Meta(ge=0, le=0.1)] = 0.02
    albedo_rms: Annotated[float, Meta(ge=0, le=0.5)] = 0.08
    seed: Seed = 1

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.posts not in [1 << k for k in range(6, 13)]:
            raise ValueError(f"posts is {self.posts}: it must be a power of two, 64 to 4096")
        if self.ridge_m > self.size_m / 3:
            raise ValueError(
                f"ridge_m is {self.ridge_m:g}: its base, three times as wide, does not fit on {self.size_m:g} m"
            )


@dataclass(frozen=True)
class Heightmap:
    """A map from a file.

    Attributes
    ----------
    path : A `.npy` of heights, (rows, columns), or a GeoTIFF with one band, north up in both.
    units_m : unit of the heights in metres; 1000 for kilometres.
    post_m : distance of posts; 0: that of the GeoTIFF.
    centre_m
        Middle of the map in the plane of a polar stereographic projection, for its latitude and stretch; read
        from a GeoTIFF that has it.
    fill_share : at most this share of the posts may be holes, which are filled from their neighbours.
    """

    kind: ClassVar[str] = "heightmap"
    path: RigFile = NO_FILE
    units_m: Annotated[float, Meta(ge=1e-6, le=1e6)] = 1.0
    post_m: Annotated[float, Meta(ge=0, le=1e5)] = 0.0
    centre_m: tuple[float, float] | None = None
    fill_share: Annotated[float, Meta(ge=0, le=0.5)] = 0.01

    def __post_init__(self) -> None:
        check_bounds(self)
        if 0 < self.post_m < 1e-3:
            raise ValueError(f"post_m must be 0 or at least 0.001, got {self.post_m!r}")
        if not self.path:
            raise ValueError("path is missing: name a .npy or .tif file")


@dataclass(frozen=True)
class TerrainParameters:
    """Ground in the light of a low Sun, seen from a camera on its path.

    The world's z is up and its y north on the map; the origin is on the ground in the middle of the map.

    Attributes
    ----------
    ground : a ridge made here, or a heightmap from a file.
    camera : the camera's path in the world.
    sun_azimuth_deg : azimuth of the Sun: 0 along +y, 90 along +x.
    sun_elevation_deg : elevation of the Sun above the horizontal; at 86 degrees south it is at most 5.5.
    sun_distance_au : distance of the Sun.
    ambient_w_m2 : light from all around, W/m2: earthshine, 0.06 on the Moon under a full Earth.
    reflectance : law of reflection of the ground.
    body_radius_m : radius of the sphere that the map lies on, 1 737 400 for the Moon; 0: the map is flat.
    detail_px
        Side of a facet in the light frame, about; slopes and shadows are those of the fine map. 0: a quarter of
        a pixel, whatever `most_facets` is.
    most_facets : facets in a large light frame are larger, so that about this many would cover it face on.
    samples : least points along each side of a pixel where a shadow ends, with run.painter = "gl" of all, 1 to 8.
    time_scale : speed of the camera's motion relative to reality.
    """

    kind: ClassVar[str] = "terrain"
    ground: Ridge | Heightmap = field(default_factory=Ridge)
    camera: TrajectoryParameters = field(default_factory=DescentPath)
    sun_azimuth_deg: Annotated[float, Meta(ge=-360, le=360)] = 60.0
    sun_elevation_deg: Annotated[float, Meta(ge=-90, le=90)] = 4.0
    sun_distance_au: Annotated[float, Meta(ge=0.01, le=1000)] = 1.0
    ambient_w_m2: Annotated[float, Meta(ge=0, le=1e6)] = EARTHLIGHT_W_M2
    reflectance: Reflectance = field(default_factory=LunarLambert)
    body_radius_m: Annotated[float, Meta(ge=0, le=1e9)] = 1_737_400.0
    detail_px: Annotated[float, Meta(ge=0, le=64)] = 2.0
    most_facets: Annotated[int, Meta(ge=1000, le=100_000_000)] = 45_000
    samples: Annotated[int, Meta(ge=1, le=8)] = 2
    time_scale: TimeScale = 1.0

    def __post_init__(self) -> None:
        check_bounds(self)
        if 0 < self.body_radius_m < 100:
            raise ValueError(f"body_radius_m must be 0 or at least 100, got {self.body_radius_m!r}")


def _needs(parameters: TerrainParameters) -> tuple[Need, ...]:
    path = getattr(parameters.ground, "path", "")
    return (package("pillow"),) if path.lower().endswith((".tif", ".tiff")) else ()


TERRAIN = SceneKind(
    TerrainParameters,
    "emulator.scene.terrain.raster_terrain:RasterTerrain",
    lens="applied",
    gl="emulator.scene.terrain.gl_terrain:GlTerrain",
    threads=True,
    needs=_needs,
)
