"""A reader of a GigE Vision event camera that counts, digests and records what arrives, until told to stop."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

from firmware_protocol.events import Events
from transports.gige.host import CameraGone, GigeHost
from transports.link.digest import digest_of
from transports.link.pacing import Clock
from transports.recording.part import Part
from transports.recording.record import Recorder

__all__ = ["GigeReception", "receive"]

_READ_TIMEOUT_S = 0.1


@dataclass(frozen=True)
class GigeReception:
    """What has arrived so far.

    Attributes
    ----------
    seconds
        Wall time since the stream was started.
    last_t_us
        Device time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    edges
        Triggers.
    blocks_lost
        Blocks that did not come whole.
    packets_asked, packets_repeated
        Packets that were asked for again, and that came more than once.
    gone
        True when the camera went away.
    """

    events: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    edges: int = 0
    blocks_lost: int = 0
    packets_asked: int = 0
    packets_repeated: int = 0
    gone: bool = False

    def with_events(self, events: Events) -> GigeReception:
        """Return this and `events`, (n,) EVENT in device time."""
        if not len(events):
            return self
        return dataclasses.replace(
            self,
            events=self.events + len(events),
            last_t_us=int(events["t"][-1]),
            digest=digest_of(events, self.digest),
        )


def receive(
    camera: GigeHost,
    packet_size: int,
    goes_on: Callable[[GigeReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
) -> GigeReception:
    """Start the camera and read it while `goes_on` says so; then stop it.

    A camera that goes away ends it too. Raises GigeHostError when the camera cannot be started.
    """
    reception = GigeReception()
    camera.start(packet_size)
    start_ns = clock.now_ns()
    try:
        while goes_on(reception):
            reception = _turn(camera, reception, recorder)
            reception = dataclasses.replace(reception, seconds=(clock.now_ns() - start_ns) * 1e-9)
        camera.stop()
        before = -1
        while reception.events > before or camera.assembly.waiting:
            before, reception = reception.events, _turn(camera, reception, recorder)
    except CameraGone:
        return dataclasses.replace(reception, gone=True)
    return reception


def _turn(camera: GigeHost, reception: GigeReception, recorder: Recorder | None) -> GigeReception:
    """Return the reception with what has come since the last turn."""
    events = camera.read(_READ_TIMEOUT_S)
    edges = camera.take_edges()
    if recorder is not None and (len(events) or len(edges)):
        recorder.append(Part(events, edges))
    return dataclasses.replace(
        reception.with_events(events),
        edges=reception.edges + len(edges),
        blocks_lost=camera.assembly.lost,
        packets_asked=camera.assembly.asked,
        packets_repeated=camera.assembly.repeated,
    )
