"""Where topics of ROS 2 are exchanged: the domain, the network interfaces, and the machines that are asked.

Without interfaces only the loopback interface is used, and only this machine is asked, by unicast. ROS 2 does the same
with ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST.

Sources: cyclonedds.io, "Configuration guide"; ros2/rmw_cyclonedds, rmw_node.cpp.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from xml.sax.saxutils import quoteattr

from transports.network.allow import is_loopback

__all__ = ["DdsNetwork", "check_topic"]

_LOOPBACK = "127.0.0.1"
_MOST_DOMAIN = 232  # beyond it DDS has no ports left
_MOST_PROCESSES = 32  # of this machine and domain: as rmw_cyclonedds
_MOST_MESSAGE = "64 MiB"
_NAME = re.compile(r"(/[A-Za-z_][A-Za-z0-9_]*)+")


@dataclass(frozen=True)
class DdsNetwork:
    """Where topics are exchanged; raises ValueError for what cannot be.

    Attributes
    ----------
    domain
        ROS_DOMAIN_ID.
    interfaces
        Names or addresses of network interfaces; empty: the loopback interface.
    peers
        Machines that are asked by unicast, beside this one.
    multicast
        Whether machines on the interfaces find each other by multicast, as ROS 2 does by default.
    """

    domain: int = 0
    interfaces: tuple[str, ...] = ()
    peers: tuple[str, ...] = ()
    multicast: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.domain <= _MOST_DOMAIN:
            raise ValueError(f"domain must be 0 to {_MOST_DOMAIN}, as ROS_DOMAIN_ID, got {self.domain}")
        elsewhere = [peer for peer in self.peers if not is_loopback(peer)]
        if not self.interfaces and (elsewhere or self.multicast):
            what = f"peers name {elsewhere[0]}" if elsewhere else "multicast is true"
            raise ValueError(
                f'interfaces is empty, which keeps all on this machine, but {what}: name the network interface, for '
                'example interfaces = ["eth0"]'
            )  # fmt: skip

    @property
    def configuration(self) -> str:
        """CycloneDDS's configuration: large datagrams on the loopback interface, bounds on what others may send."""
        names = self.interfaces or (_LOOPBACK,)
        interfaces = "".join(_interface(name) for name in names)
        peers = "".join(f"<Peer address={quoteattr(peer)}/>" for peer in (_LOOPBACK, *self.peers))
        sizes = "" if self.interfaces else "<MaxMessageSize>65500B</MaxMessageSize><FragmentSize>60000B</FragmentSize>"
        return (
            f"<CycloneDDS><Domain><General><Interfaces>{interfaces}</Interfaces>"
            f"<AllowMulticast>{'true' if self.multicast else 'false'}</AllowMulticast>{sizes}</General>"
            f"<Discovery><ParticipantIndex>auto</ParticipantIndex>"
            f"<MaxAutoParticipantIndex>{_MOST_PROCESSES}</MaxAutoParticipantIndex><Peers>{peers}</Peers></Discovery>"
            # A writer never waits: what its readers have not acknowledged is bounded by the depth of its history.
            "<Internal><Watermarks><WhcHigh>1 GiB</WhcHigh></Watermarks>"
            '<HeartbeatInterval min="2 ms" minsched="4 ms" max="1 s">5 ms</HeartbeatInterval>'
            f"<MaxSampleSize>{_MOST_MESSAGE}</MaxSampleSize></Internal>"
            "<Tracing><Verbosity>none</Verbosity></Tracing></Domain></CycloneDDS>"
        )


def check_topic(key: str, topic: str) -> None:
    """Raise ValueError for what is no absolute name of a topic."""
    if not _NAME.fullmatch(topic):
        raise ValueError(
            f'{key} is {topic!r}: a topic begins with "/" and has letters, digits, "_" and "/", such as '
            '"/event_camera/events"'
        )  # fmt: skip


def _interface(name: str) -> str:
    key = "address" if name[:1].isdigit() or ":" in name else "name"
    return f"<NetworkInterface {key}={quoteattr(name)}/>"
