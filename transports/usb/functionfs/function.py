"""What the kernel's FunctionFS is to the camera's side of it: one control pipe and one pipe for each endpoint.

`transports.usb.functionfs.files` has the real ones. Calls block; each pipe is used by a thread of its own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

from firmware_protocol.usb.functionfs import Event

__all__ = ["ControlPipe", "DataPipe", "Function"]


class ControlPipe(Protocol):
    """Endpoint 0."""

    def next_event(self) -> Event | None:
        """Wait for the next event; None after `wake`."""

    def wake(self) -> None:
        """End the waiting of `next_event`, from another thread."""

    def send(self, data: bytes) -> None:
        """Do the data stage of an IN request; raises OSError when the host gave up."""

    def receive(self, length: int) -> bytes:
        """Do the data stage of an OUT request, or acknowledge one without; raises OSError when the host gave up."""

    def refuse(self, *, is_in: bool) -> None:
        """Stall the request, before its data stage; raises OSError when the host gave up."""


class DataPipe(Protocol):
    """One endpoint but 0."""

    @property
    def number(self) -> int:
        """Number of the camera's endpoint, without the direction bit."""

    @property
    def is_in(self) -> bool:
        """True where data go to the host."""

    def packet_bytes(self) -> int:
        """Length of a full packet at the speed of the moment."""

    def write(self, data: bytes) -> None:
        """Give data to the host; returns when it has them. Raises OSError."""

    def read(self, most_bytes: int) -> bytes:
        """Take one transfer of the host. Raises OSError."""

    def halt(self) -> None:
        """Let the host's transfers fail until it clears the halt. Raises OSError."""

    def interrupt(self) -> None:
        """End the call that blocks now in another thread, with InterruptedError; one that begins later goes on."""


class Function(Protocol):
    """An interface at a USB device controller."""

    @property
    def control(self) -> ControlPipe:
        """Endpoint 0."""

    @property
    def pipes(self) -> Sequence[DataPipe]:
        """The other endpoints that the camera uses."""
