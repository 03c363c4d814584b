"""The computer's side of a serial line: bytes in, events, edges and reports out. Knows no port and no clock.

Use::

receiver = SerialReceiver("ccsds-cobs")
receiver.push(port.read())
events = receiver.take_events()
"""

from __future__ import annotations

from collections.abc import Mapping

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.packets.housekeeping import Housekeeping
from firmware_protocol.packets.profile import Profile
from firmware_protocol.packets.telecommands import Telecommand
from firmware_protocol.receiver.inbox import Inbox
from firmware_protocol.receiver.messages import MessageReader

__all__ = ["SerialReceiver"]


class SerialReceiver:
    """Decodes an instrument's bytes; wraps telecommands and follows their answers.

    Parameters
    ----------
    profile
        The name of one of `PROFILES`, or a profile with other addresses. Raises ValueError for an unknown name.
    """

    def __init__(self, profile: Profile | str = "ccsds-cobs") -> None:
        self._profile = Profile(profile) if isinstance(profile, str) else profile
        self._unwrapper = self._profile.unwrapper()
        self._inbox = Inbox()
        self._messages = MessageReader(self._inbox)
        self._telecommands = self._resynchronised = 0
        self._began = self._lost = False
        self._damaged_at_start = 0
        self._damaged = 0

    def wrap(self, command: Telecommand) -> bytes:
        """Return the bytes of a telecommand; its answers will come as reports."""
        octets = self._profile.wrap_command(command)
        if self._profile.last_request is not None:
            self._messages.expect(self._profile.last_request, type(command).__name__)
        self._telecommands += 1
        return octets

    def push(self, data: bytes) -> None:
        """Take the next bytes, any number of them; never raises."""
        received = self._unwrapper.push(data)
        self._follow(bool(received))
        for each in received:
            self._messages.read(each.message)

    def take_events(self) -> Events:
        """See `Inbox.take_events`."""
        return self._inbox.take_events()

    def take_edges(self) -> Edges:
        """See `Inbox.take_edges`."""
        return self._inbox.take_edges()

    def take_reports(self) -> tuple[str, ...]:
        """Return what the instrument answered since the last call, in words for people."""
        return self._inbox.take_reports()

    @property
    def housekeeping(self) -> Housekeeping | None:
        """The newest report; None before the first."""
        return self._messages.housekeeping

    @property
    def faults(self) -> int:
        """Things that a sound line never shows: damage after the first good frame, gaps, blocks that are wrong."""
        seen = self._unwrapper.counters
        return self._damaged - self._damaged_at_start + seen.missing + seen.disordered + self._messages.bad

    @property
    def counts(self) -> Mapping[str, int]:
        """Everything by name."""
        seen = self._unwrapper.counters
        reasons = seen.frames.refused + seen.refused
        counts = {
            "bytes": seen.frames.bytes_received,
            "bytes_skipped": seen.frames.bytes_skipped,
            "frames": seen.frames.frames,
            "messages_missing": seen.missing,
            "messages_disordered": seen.disordered,
            **{f"damaged: {reason}": count for reason, count in reasons.items()},
            **self._messages.counts,
            **self._inbox.counts,
        }
        more = {"telecommands": self._telecommands, "resynchronised": self._resynchronised}
        return counts | {name: count for name, count in more.items() if count}

    def _follow(self, good: bool) -> None:
        """Count how often the stream was lost and found again; what was damaged before the first frame is no fault."""
        seen = self._unwrapper.counters
        damaged = sum(seen.frames.refused.values()) + sum(seen.refused.values())
        self._lost |= self._began and damaged > self._damaged
        self._damaged = damaged
        if good and not self._began:
            self._began, self._damaged_at_start = True, damaged
        elif good and self._lost:
            self._lost = False
            self._resynchronised += 1
