"""A reader of a camera on USB that counts, digests and records what arrives, until it is told to stop or unplugged."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from firmware_protocol.events import Events, empty_events
from transports.link.digest import digest_of
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder
from transports.usb.cameras import CameraHost
from transports.usb.davis_host import StreamSettings
from transports.usb.host import PeerGone

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
    edges
        What the external input told of.
    """

    events: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    gone: bool = False
    edges: int = 0

    def with_events(self, events: Events, edges: int = 0) -> Reception:
        """Return this and `events`, in device time, and so many edges."""
        more = dataclasses.replace(self, edges=self.edges + edges)
        if not len(events):
            return more
        return dataclasses.replace(
            more,
            events=self.events + len(events),
            last_t_us=int(events["t"][-1]),
            digest=digest_of(events, self.digest),
        )

    def at(self, seconds: float, faults: int, *, gone: bool = False) -> Reception:
        """Return this at a later moment."""
        return dataclasses.replace(self, seconds=seconds, faults=faults, gone=gone)


def receive(
    camera: CameraHost, goes_on: Callable[[Reception], bool], clock: Clock, recorder: Recorder | None = None
) -> Reception:
    """Start the camera and read it while `goes_on` says so, which is asked after each transfer; then stop it.

    A camera that goes away ends it too. Raises UsbHostError when the camera cannot be started.
    """
    reception = Reception()
    start_ns = clock.now_ns()

    def take(events: Events | None) -> None:
        nonlocal reception
        events, edges = empty_events() if events is None else events, camera.take_edges()
        reception = reception.with_events(events, len(edges))
        if recorder is not None and (len(events) or len(edges)):
            recorder.append(Part(events, edges))
        reception = reception.at((clock.now_ns() - start_ns) * 1e-9, camera.faults.total)

    camera.start(StreamSettings(edges=True))
    try:
        while goes_on(reception):
            take(camera.read(_READ_TIMEOUT_S))
        take(camera.stop())
    except PeerGone:
        return reception.at(reception.seconds, camera.faults.total, gone=True)
    return reception
