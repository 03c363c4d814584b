"""The table and the record of loopback links: a host in the link's own process."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

from transports.link.endpoint import EndpointFactory
from transports.link.kind import LinkKind, Wiring

__all__ = ["LOOPBACK", "LoopbackLink"]


@dataclass(frozen=True)
class LoopbackLink:
    """A host inside the link's own process that starts the camera, decodes every byte and compares: no USB anywhere.

    Attributes
    ----------
    name
        What this rig calls the link: in reports, and where faults and triggers name it.
    """

    kind: ClassVar[str] = "loopback"
    name: str = "loopback"


def _endpoint(link: LoopbackLink, wiring: Wiring) -> EndpointFactory[Any]:
    from transports.usb.loopback import LoopbackFactory

    return LoopbackFactory()


# Its host reads a DAVIS346, of any size, and never loses its way at the start, so the camera need not wait.
LOOPBACK = LinkKind(LoopbackLink, serves="usb", endpoint=_endpoint, usb_model="davis346", start_delay=False)
