"""What the control channel of a camera hands on to its stream, in the order in which it was accepted.

The control channel has checked an order and answered it; the stream carries it out. So both may run in processes of
their own: see `Triton2Control` and `Triton2`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

from firmware_protocol.gige.gvcp import Resend

__all__ = ["DeviceTime", "Order", "Owner", "Peer", "Pulse", "TimeSource", "Write"]

Peer = tuple[str, int]


@dataclass(frozen=True)
class Write:
    """A host wrote a register."""

    address: int
    value: int


@dataclass(frozen=True)
class Pulse:
    """An action gives a pulse on the trigger input, at a time of the device's clock; None: now."""

    time_ns: int | None = None


@dataclass(frozen=True)
class Owner:
    """A host has control from now on; None: nobody has."""

    peer: Peer | None


Order = Write | Resend | Pulse | Owner


class DeviceTime(NamedTuple):
    """The device's clock since the last of so many starts of the acquisition."""

    starts: int
    ns: int


TimeSource = Callable[[], DeviceTime]
