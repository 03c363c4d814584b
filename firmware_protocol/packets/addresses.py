"""Who is who on the link: the numbers under which an instrument and the computer it serves know each other."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["DEFAULT_ADDRESSES", "Addresses"]

_APIDS = range(1, 0x7FF)


@dataclass(frozen=True)
class Addresses:
    """Identifiers of one instrument; both sides need the same. Raises ValueError for one out of range.

    Attributes
    ----------
    apid
        Application process of the instrument: telecommands, and all that it says but events.
    science_apid
        Application process of events and edges.
    csp_node, csp_peer
        CSP addresses of the instrument and of the computer, 0..16383 (version 2).
    """

    apid: int = 0x2A0
    science_apid: int = 0x2A1
    csp_node: int = 10
    csp_peer: int = 1

    def __post_init__(self) -> None:
        for apid in (self.apid, self.science_apid):
            if apid not in _APIDS:
                raise ValueError(f"APID {apid:#x} is not in 0x001..0x7fe")
        if self.apid == self.science_apid:
            raise ValueError(f"events need an APID of their own, both are {self.apid:#x}")
        for node in (self.csp_node, self.csp_peer):
            if not 0 <= node < 1 << 14:
                raise ValueError(f"CSP address {node} is not in 0..16383")


DEFAULT_ADDRESSES = Addresses()
