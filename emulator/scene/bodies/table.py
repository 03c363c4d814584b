"""Bodies in sunlight, as a rig writes them."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import ClassVar

from emulator.photometry.reflectance import LommelSeeliger, Reflectance
from emulator.photometry.sun import Sun
from emulator.scene.bodies.detail_table import Bare, Detail
from emulator.scene.kind import SceneKind
from emulator.tables.files import NO_FILE, RigFile
from emulator.trajectory.parameters import FixedPath, TrajectoryParameters

__all__ = ["BODIES", "BodiesParameters", "BodyTable"]


@dataclass(frozen=True)
class BodyTable:
    """One body.

    Attributes
    ----------
    name
        What others call it who are fixed to it.
    shape
        A file, or the name of a shipped model: 'eros007790', 'eros022540', 'itokawa_49152', or a part of the
        rendezvous target: 'target_bus', 'target_panel', 'target_ring', 'target_plate', 'target_marks';
        or 'globe', a ball of radius 1.
    units_m
        The shape's unit of length in metres; 1000 for kilometres.
    path
        Where it is, in the world or in the frame of `fixed_to`.
    fixed_to
        Name of the body that it stands on; empty: the world.
    reflectance
        How it throws light back.
    detail
        What is made up on it beyond the shape model.
    smooth
        Whether normals are interpolated over facets, as for ground; false shows each facet flat, as for foil and boxes.
    throws_shadow
        Whether it can stand in the light of itself and others.
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
        Where the Sun stands, and how far.
    ambient_w_m2
        Light from all around, W/m2: earthshine, 0.06 on the Moon under a full Earth.
    samples
        With run.painter = "gl", light is averaged over samples x samples points of each pixel, 1 to 4.
    detail_px
        Facets smaller than this are gathered into larger ones, pixels; 0 keeps every facet.
    shadows
        Whether bodies throw shadows.
    time_scale
        How much faster than in reality everything moves.
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
)
