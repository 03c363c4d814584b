"""The faults of packets in datagrams, as a rig writes them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

from transports.faults.kinds import BitFlips, Fault, HitFault

__all__ = ["DATAGRAM_FAULTS", "LateDatagrams", "LostDatagrams", "RepeatedDatagrams"]


@dataclass(frozen=True)
class LostDatagrams(HitFault):
    """Datagrams that never arrive, as where a queue on the way is full."""

    kind: ClassVar[str] = "lost_datagrams"


@dataclass(frozen=True)
class RepeatedDatagrams(HitFault):
    """Datagrams that arrive twice."""

    kind: ClassVar[str] = "repeated_datagrams"


@dataclass(frozen=True)
class LateDatagrams(HitFault):
    """Datagrams that others overtake.

    Attributes
    ----------
    overtaken_by
        How many others pass each.
    """

    kind: ClassVar[str] = "late_datagrams"
    overtaken_by: int = 1

    def __post_init__(self) -> None:
        super().__post_init__()
        if not 1 <= self.overtaken_by <= 1000:
            raise ValueError(f"overtaken_by must be 1 to 1000 datagrams, got {self.overtaken_by}")


DATAGRAM_FAULTS: Mapping[str, type[Fault]] = {
    each.kind: each for each in (LostDatagrams, RepeatedDatagrams, LateDatagrams, BitFlips)
}
"""Faults of packets in datagrams, by kind. Bits flip where no checksum of UDP sees it, as in a gateway."""
