"""Unlinks that came before the URB that they take back.

Linux's vhci_hcd sends all URBs that wait, then all unlinks that wait. A URB that is queued and taken back between the
two leaves after its unlink. An answer to the unlink would then be wrong whatever it said: the kernel has either not
sent the URB yet, forgets the unlink, and its program waits for the URB for ever; or it gives the URB back, does not
know it when its data come, and drops the device. libcaer takes back and submits transfers in two threads: it was seen
to lose the camera so, and once to wait without end. So the unlink waits for its URB, which then ends as one that was
pending.

Sequence numbers of URBs rise (vhci_hcd numbers them as it queues them), modulo 2^32.
"""

from __future__ import annotations

from enum import Enum

from firmware_protocol.usb.usbip import Unlink

__all__ = ["EarlyUnlinks", "Found"]

_HALF = 1 << 31


class Found(Enum):
    """How an unlink found its URB."""

    PENDING = "pending"
    OVER = "over, or never seen"
    STILL_TO_COME = "still to come"


class EarlyUnlinks:
    """The unlinks of one connection whose URBs are still to come, at most `limit`."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._newest: int | None = None
        self._waiting: dict[int, Unlink] = {}

    def submitted(self, seqnum: int) -> Unlink | None:
        """Hear of a new URB; return the unlink that waited for it."""
        self._newest = seqnum
        return self._waiting.pop(seqnum, None)

    def keep(self, unlink: Unlink) -> bool:
        """Keep an unlink if its URB is still to come; False where it is not, or where too many wait."""
        ahead = 1 if self._newest is None else (unlink.victim - self._newest) % (2 * _HALF)
        if not 0 < ahead < _HALF or len(self._waiting) >= self._limit:
            return False
        self._waiting[unlink.victim] = unlink
        return True
