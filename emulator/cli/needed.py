"""What a rig needs of this machine, as it was found: for `evstim rigs` and `evstim doctor RIG`."""

from __future__ import annotations

from dataclasses import dataclass

from emulator.rig.loading import Rig
from emulator.run.needs import needs_of
from transports.needs import By, Finding

__all__ = ["Needed", "what_is_needed"]

_WORDS = {"run": "needs", "driver": "drivers on this machine need"}


@dataclass(frozen=True)
class Needed:
    """One thing that a rig needs; `by` as in `transports.needs.Need`."""

    name: str
    by: By
    found: Finding

    @property
    def stops_the_run(self) -> bool:
        """Whether the rig does not run here for want of it."""
        return self.by == "run" and not self.found.good

    @property
    def line(self) -> str:
        """It in words, with the command that adds it where it is missing."""
        state = "there" if self.found.good else f"missing; {self.found.fix}"
        return f"{_WORDS[self.by]} the {self.name}: {state}"

    def as_json(self) -> dict[str, object]:
        """Return it for JSON; `fix` is a shell command, null where the thing is there."""
        return {"name": self.name, "by": self.by, "good": self.found.good, "fix": self.found.fix}


def what_is_needed(rig: Rig) -> tuple[Needed, ...]:
    """Return what a rig needs of this machine, as it was found."""
    return tuple(Needed(need.name, need.by, need.look()) for need in needs_of(rig))
