"""A reader of a DAVIS346 that counts, digests and records what arrives, until told to stop or the camera is gone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from firmware_protocol.events import Events
from transports.davis_host import DavisHost, StreamSettings
from transports.digest import digest_of
from transports.pacing import Clock
from transports.record import Recorder
from transports.usb_host import PeerGone

__all__ = ["Reception", "receive"]

_READ_TIMEOUT_S = 0.1


@dataclass(frozen=True)
class Reception:
    """What has arrived so far.

    Attributes
    ----------
    seconds
        Wall time since the stream was started.
    last_t_us
        Device time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    faults
        Words that a healthy stream does not hold.
    gone
        True when the camera went away.
    """

    events: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    gone: bool = False

    def with_events(self, events: Events) -> Reception:
        """Return this and `events`, in device time."""
        if not len(events):
            return self
        digest = digest_of(events, self.digest)
        return Reception(self.events + len(events), self.seconds, int(events["t"][-1]), digest, self.faults, self.gone)

    def at(self, seconds: float, faults: int, *, gone: bool = False) -> Reception:
        """Return this at a later moment."""
        return Reception(self.events, seconds, self.last_t_us, self.digest, faults, gone)


def receive(
    camera: DavisHost, goes_on: Callable[[Reception], bool], clock: Clock, recorder: Recorder | None = None
) -> Reception:
    """Start the camera and read it while `goes_on` says so, which is asked after each transfer; then stop it.

    A camera that goes away ends it too. Raises UsbHostError when the camera cannot be started.
    """
    reception = Reception()
    start_ns = clock.now_ns()

    def take(events: Events | None) -> None:
        nonlocal reception
        if events is not None and len(events):
            reception = reception.with_events(events)
            if recorder is not None:
                recorder.append(events)
        reception = reception.at((clock.now_ns() - start_ns) * 1e-9, camera.faults.total)

    camera.start(StreamSettings())
    try:
        while goes_on(reception):
            take(camera.read(_READ_TIMEOUT_S))
        take(camera.stop())
    except PeerGone:
        return reception.at(reception.seconds, camera.faults.total, gone=True)
    return reception
