"""Where the page is served, and who may use it.

    --serve                       127.0.0.1 and a free port: programs on this machine only, no token
    --serve 127.0.0.1:8080
    --serve 0.0.0.0:8080          other machines can reach it: a token is made, and printed as part of the address

Any page that a browser shows could open a WebSocket to this machine. So the page's own Origin is asked for, and a Host
that is an address of this machine (a name that somebody else's DNS resolves to 127.0.0.1 is not).
"""

from __future__ import annotations

import secrets
from dataclasses import dataclass
from urllib.parse import urlsplit

from transports.network.allow import is_loopback

__all__ = ["Access", "Address", "parse_address"]

_TOKEN_BYTES = 16


@dataclass(frozen=True)
class Address:
    """Where to listen; port 0: a free one."""

    host: str = "127.0.0.1"
    port: int = 0


def parse_address(text: str) -> Address:
    """Return HOST:PORT, HOST, :PORT or [IPv6]:PORT as an address; raises ValueError."""
    try:
        parts = urlsplit(f"//{text}")
        host, port = parts.hostname, parts.port
    except ValueError as error:
        raise ValueError(f"{text!r} is no HOST:PORT: {error}") from error
    if parts.username is not None or parts.path or parts.query or parts.fragment:
        raise ValueError(f"{text!r} is no HOST:PORT, such as 127.0.0.1:8080")
    return Address(host or "127.0.0.1", port or 0)


@dataclass(frozen=True)
class Access:
    """Who may use the page: those with the token; without one, pages that this machine itself has loaded."""

    token: str = ""

    @classmethod
    def for_host(cls, host: str) -> Access:
        """Return what is needed for a page at `host`: a new token where other machines can reach it."""
        return cls() if is_loopback(host) else cls(secrets.token_hex(_TOKEN_BYTES))

    def origin_permitted(self, origin: str | None, host: str | None) -> bool:
        """Say whether a WebSocket may be opened, from the headers Origin (None: no browser sent it) and Host."""
        if host is None:
            return False
        if not self.token and not _names_loopback(host):
            return False
        return origin is None or urlsplit(origin).netloc == host

    def permits(self, token: str) -> bool:
        """Say whether this is the token, in a time that tells nothing of it."""
        return not self.token or secrets.compare_digest(token.encode(), self.token.encode())


def _names_loopback(host: str) -> bool:
    try:
        return is_loopback(urlsplit(f"//{host}").hostname or "")
    except ValueError:
        return False
