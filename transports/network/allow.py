"""The addresses that may connect to a port: single addresses and networks, written as in a rig.

    host = "127.0.0.1"                                             only programs on this machine: no list needed
    host = "192.168.1.7", allow = ["10.0.0.5", "192.168.1.0/24"]   reachable from elsewhere: the list is required

Nothing here authenticates a peer. A list keeps out other machines of a network that is otherwise trusted.
"""

from __future__ import annotations

import ipaddress
from collections.abc import Iterable, Sequence

__all__ = ["LOOPBACK", "AllowList", "check_allow", "is_loopback"]

LOOPBACK = ("127.0.0.0/8", "::1/128")
"""Who may connect where a rig gives no list."""

_Address = ipaddress.IPv4Address | ipaddress.IPv6Address


class AllowList:
    """Addresses and networks; raises ValueError for a text that is neither. An empty list stands for `LOOPBACK`."""

    def __init__(self, entries: Iterable[str] = ()) -> None:
        self._networks = tuple(_network(entry) for entry in tuple(entries) or LOOPBACK)

    def permits(self, address: str) -> bool:
        """Say whether a peer at a numeric address may connect; an IPv4 address inside IPv6 counts as itself."""
        try:
            peer = _plain(address)
        except ValueError:
            return False
        return any(peer in network for network in self._networks)


def is_loopback(host: str) -> bool:
    """Say whether an address to listen on is certain to be out of reach for other machines."""
    if host == "localhost":
        return True
    try:
        return _plain(host).is_loopback
    except ValueError:
        return False


def check_allow(host: str, allow: Sequence[str], key: str = "host") -> None:
    """Check a rig's `host` and `allow`; raises ValueError when others reach the host and nobody says who may."""
    try:
        AllowList(allow)
    except ValueError as error:
        raise ValueError(f"allow: {error}") from error
    if not allow and not is_loopback(host):
        where = repr(host) if host else "'', which means every address of this machine,"
        raise ValueError(
            f'{key} {where} can be reached from other machines: say who may connect, for example allow = ["10.0.0.5", '
            f'"192.168.1.0/24"], or use {key} = "127.0.0.1"'
        )


def _network(entry: str) -> ipaddress.IPv4Network | ipaddress.IPv6Network:
    try:
        return ipaddress.ip_network(entry)
    except ValueError as error:
        raise ValueError(f'{entry!r} is neither an address nor a network such as "192.168.1.0/24" ({error})') from error


def _plain(address: str) -> _Address:
    """Return an address without its zone, and an IPv4 address that is written as IPv6 as IPv4."""
    plain = ipaddress.ip_address(address.partition("%")[0])
    mapped = plain.ipv4_mapped if isinstance(plain, ipaddress.IPv6Address) else None
    return mapped or plain
