"""A computer on a serial line: reads an instrument until told to stop or the line is gone; may tell it something."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.telecommands import Telecommand
from firmware_protocol.receiver.serial import SerialReceiver
from transports.link.arrivals import Arrivals
from transports.link.latency import LatencySummary
from transports.link.pacing import Clock
from transports.link.record import Recorder
from transports.serial_line.opening import open_port
from transports.serial_line.parameters import SerialParameters
from transports.serial_line.port import Port

__all__ = ["SerialReception", "listen_serial"]

_LOOK_PERIOD_NS = 500_000
_MOST_TOLD = 1024


@dataclass(frozen=True)
class SerialReception:
    """What has come so far.

    Attributes
    ----------
    seconds
        Wall time since the port was opened.
    last_t_us
        The camera's time of the newest event; None before the first.
    digest
        Of all events, see `digest_of`.
    faults
        Things that a sound line never shows: damaged frames, gaps in the counts, blocks that are wrong.
    counts
        Everything by name; `events_dropped` is what the camera says that it dropped.
    jitter_us
        How much later than the quickest block each came: the camera's clock is not known.
    housekeeping
        The newest report.
    answers
        Number of answers to telecommands.
    told
        The newest of them in words, at most 1024.
    gone
        True when the other side went away.
    """

    events: int = 0
    edges: int = 0
    seconds: float = 0.0
    last_t_us: int | None = None
    digest: int = 0
    faults: int = 0
    counts: Mapping[str, int] = field(default_factory=dict)
    jitter_us: LatencySummary = field(default_factory=LatencySummary)
    housekeeping: Housekeeping | None = None
    answers: int = 0
    told: tuple[str, ...] = ()
    gone: bool = False


class _Listening:
    """One visit to the line."""

    def __init__(self, profile: str, clock: Clock, recorder: Recorder | None) -> None:
        self.receiver = SerialReceiver(profile)
        self._clock = clock
        self._arrivals = Arrivals(clock, recorder)
        self._told: tuple[str, ...] = ()
        self._answers = 0

    @property
    def now(self) -> SerialReception:
        """What has come so far, without what is known at the end alone."""
        a = self._arrivals
        counted = SerialReception(a.events, a.edges, a.seconds, a.last_t_us, a.digest)
        return replace(counted, answers=self._answers, told=self._told)

    def take(self, data: bytes) -> None:
        """Hear bytes that have come just now."""
        now_ns = self._clock.now_ns()
        self.receiver.push(data)
        self._arrivals.add(self.receiver.take_events(), self.receiver.take_edges(), now_ns)
        told = self.receiver.take_reports()
        self._answers += len(told)
        self._told = (self._told + told)[-_MOST_TOLD:]

    def finish(self, *, gone: bool) -> SerialReception:
        """Return everything."""
        receiver = self.receiver
        return replace(
            self.now,
            faults=receiver.faults,
            counts=receiver.counts,
            jitter_us=self._arrivals.jitter(),
            housekeeping=receiver.housekeeping,
            gone=gone,
        )


def listen_serial(
    line: SerialParameters,
    goes_on: Callable[[SerialReception], bool],
    clock: Clock,
    recorder: Recorder | None = None,
    commands: Sequence[Telecommand] = (),
) -> SerialReception:
    """Open the port, tell `commands`, and read while `goes_on` says so, which is asked after each look.

    Raises OSError when the port cannot be had; one that goes away later ends the visit.
    """
    listening = _Listening(line.profile, clock, recorder)
    port = open_port(line)
    unsent = b"".join(listening.receiver.wrap(command) for command in commands)
    gone = False
    try:
        while goes_on(listening.now):
            unsent = unsent[port.write(unsent) :] if unsent else b""
            listening.take(_all_there(port))
            clock.sleep_until(clock.now_ns() + _LOOK_PERIOD_NS)
    except OSError:
        gone = True
    finally:
        port.close()
    return listening.finish(gone=gone)


def _all_there(port: Port) -> bytes:
    parts = []
    while data := port.read():
        parts.append(data)
    return b"".join(parts)
