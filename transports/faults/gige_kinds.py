"""The faults of a GigE Vision camera beside those of datagrams, as a rig writes them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = ["LinkDown", "LostHeartbeat", "RefusedResends"]


@dataclass(frozen=True)
class RefusedResends(HitFault):
    """Packets that a host asks for again and that the camera says it keeps no more, as one with a small memory."""

    kind: ClassVar[str] = "refused_resends"


@dataclass(frozen=True)
class LostHeartbeat(Fault):
    """The camera takes control away from its host, as when the host's heartbeat did not come in time."""

    kind: ClassVar[str] = "lost_heartbeat"


@dataclass(frozen=True)
class LinkDown(LastingFault):
    """The cable is pulled out and put in again: nothing goes either way meanwhile."""

    kind: ClassVar[str] = "link_down"
