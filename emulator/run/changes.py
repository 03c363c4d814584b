"""What changed a run from outside: who changed what, and from which stream time on it acts.

A host writes a register or sends a telecommand, a viewer of the live page moves a slider, `evstim fault` begins a
fault. The run then no longer follows from its rig and its seed alone. With this record it can be understood, and done
again.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

from firmware_protocol.edges import EdgeKind
from transports.faults.kinds import Fault

__all__ = ["Change", "Changes", "Operator"]

_MOST = 10_000


@dataclass(frozen=True)
class Change:
    """One change.

    Attributes
    ----------
    t_ns
        Stream time from which it acts: of a figure of the sensor, the end of a step.
    by
        "register", "telecommand", "restart" of a link; "live page", "evstim" (its verbs fault and trigger), "program".
    link
        The link over which it came, or that it concerns; empty for none.
    what
        A figure of the sensor such as "threshold_on"; a fault, an edge by hand, a telecommand.
    before, after
        Values of the figure; None where there are none.
    taken_us
        Stream time that the camera had reached when it took it; None where no camera did.
    """

    t_ns: int
    by: str
    what: str
    link: str = ""
    before: float | None = None
    after: float | None = None
    taken_us: int | None = None

    def as_json(self) -> dict[str, object]:
        """Return the object that `evstim run --json` prints."""
        return {
            "t_us": self.t_ns / 1000,
            "by": self.by,
            "link": self.link,
            "what": self.what,
            "before": self.before,
            "after": self.after,
            "taken_us": self.taken_us,
        }

    @property
    def told(self) -> str:
        """Return a line for people."""
        whose = f"{self.link}: " if self.link else ""
        values = "" if self.after is None else f" {self.before:.4g} -> {self.after:.4g}"
        return f"{self.t_ns * 1e-9:.6f} s: {whose}{self.what}{values} ({self.by})"


class Changes:
    """The changes of a run; beyond 10 000 they are counted only.

    Attributes
    ----------
    beyond : changes that are counted and not listed.
    """

    def __init__(self) -> None:
        self._listed: list[Change] = []
        self.beyond = 0

    def add(self, change: Change) -> None:
        """Add one."""
        if len(self._listed) < _MOST:
            self._listed.append(change)
        else:
            self.beyond += 1

    @property
    def listed(self) -> tuple[Change, ...]:
        """Those that are listed, sorted by the stream time from which they act."""
        return tuple(sorted(self._listed, key=lambda change: change.t_ns))


class _Session(Protocol):
    @property
    def stopping(self) -> bool:
        """See `Session.stopping`."""
        ...

    @property
    def adjustable(self) -> dict[str, float]:
        """See `Session.adjustable`."""
        ...

    def adjust(self, name: str, value: float, by: str) -> None:
        """See `Session.adjust`."""

    def inject(self, fault: Fault, by: str) -> None:
        """See `Session.inject`."""

    def happen(self, link: str, kind: EdgeKind | None, by: str) -> None:
        """See `Session.happen`."""

    def record(self, change: Change) -> None:
        """See `Session.record`."""


class Operator:
    """Access to a running session for a user, whose name stands in the record of what was changed.

    Parameters
    ----------
    by : the name.
    """

    def __init__(self, session: _Session, by: str) -> None:
        self._session, self._by = session, by

    @property
    def stopping(self) -> bool:
        """True when the run ends after the present step."""
        return self._session.stopping

    @property
    def adjustable(self) -> dict[str, float]:
        """Figures of the sensor that can change, with their present values."""
        return self._session.adjustable

    def adjust(self, name: str, value: float) -> None:
        """Change one from the next step on; raises ValueError."""
        self._session.adjust(name, value, self._by)

    def inject(self, fault: Fault) -> None:
        """Begin a fault on the link that it names."""
        self._session.inject(fault, self._by)

    def happen(self, link: str, kind: EdgeKind | None) -> None:
        """Let an edge come to the input of a link's camera, or its clock start anew."""
        self._session.happen(link, kind, self._by)

    def record(self, t_us: int, what: str) -> None:
        """Record something that was done to all cameras, and acts at a stream time."""
        self._session.record(Change(t_us * 1000, self._by, what))
