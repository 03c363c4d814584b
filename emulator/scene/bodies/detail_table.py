"""What is made up on a body beyond its shape model, as a rig writes it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

__all__ = ["Bare", "Clouds", "Detail", "Regolith"]


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
    coarse for them, down to what the camera sees at its closest; the smallest rise with the camera's nearness.

    Attributes
    ----------
    seed
        Of all that is drawn by lot.
    boulders_km2
        Boulders larger than 5 m on a square kilometre; 0: none. 949 on Itokawa (Michikami et al. 2008).
    boulder_power
        Their number goes with this power of their size: -3.1 on Itokawa.
    craters
        N(> D) D^2, craters larger than D per m2 times D^2: 0.046 where they are 3 % of geometric saturation; 0: none.
    crater_depth
        Depth over diameter of a fresh crater; old ones are shallower, to a quarter of it.
    slope_deg
        Root mean square slope that roughness adds to facets.
    albedo_rms
        Root mean square variation of albedo, relative; its mean is that of the body's reflectance.
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
        _require(self, "smallest_m", 1e-3, 1e6)
        _require(self, "facet_px", 0.5, 100)
        _require(self, "most_facets", 100, 2_000_000)


@dataclass(frozen=True)
class Clouds:
    """A planet like the Earth: the shape made round, with oceans, land, and clouds in belts about its +z axis.

    Attributes
    ----------
    seed
        Of continents and clouds.
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
