"""The faults of a GigE Vision camera beside those of datagrams, as a rig writes them."""

from __future__ import annotations

import ipaddress
from dataclasses import dataclass
from typing import ClassVar

from transports.faults.kinds import Fault, HitFault, LastingFault

__all__ = ["IpChange", "LinkDown", "LostHeartbeat", "RefusedResends"]


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


@dataclass(frozen=True)
class IpChange(LastingFault):
    """The camera leaves its IP address and comes back with another one, as after a new DHCP lease or a FORCEIP.

    Attributes
    ----------
    for_s
        How long it has none.
    address
        IPv4 address that it has afterwards, to the end of the run; one of this machine's, on loopback any 127.x.y.z.
    """

    kind: ClassVar[str] = "ip_change"
    for_s: float = 0.5
    address: str = "127.0.0.254"

    def __post_init__(self) -> None:
        super().__post_init__()
        try:
            good = not ipaddress.IPv4Address(self.address).is_unspecified
        except ValueError:
            good = False
        if not good:
            raise ValueError(f"address must be an IPv4 address that the camera has afterwards, got {self.address!r}")
