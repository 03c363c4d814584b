"""What a viewer may ask of a running session, and the session's answers; all in the session's own thread."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Any, Protocol

from emulator.run.outcome import RunStatus
from transports.faults.kinds import Fault

__all__ = ["Orders", "RunningSession"]

_LARGEST = 1e9  # JSON has no infinity


class RunningSession(Protocol):
    """The parts of a `Session` that viewers can reach."""

    @property
    def stopping(self) -> bool:
        """True after `stop`."""
        ...

    @property
    def adjustable(self) -> dict[str, float]:
        """Figures that can change, with their present values."""
        ...

    def adjust(self, name: str, value: float) -> None:
        """Change one from the next step on; raises ValueError."""

    def inject(self, fault: Fault) -> None:
        """Begin a fault."""


Inject = Callable[[dict[str, Any], RunStatus], dict[str, Any]]
"""Answers {"ask": "inject", "fault": table}, as `FaultInjection.answer`."""


class Orders:
    """Carries out what viewers ask.

    Parameters
    ----------
    trigger
        Makes an edge on the cameras' external input, at a time of CLOCK_MONOTONIC (ns), with a number; None where the
        rig has a trigger of its own.
    can_pause
        Whether the run may stand still: one that is not paced, and that no bus drives.

    Attributes
    ----------
    paused
        Whether the run is to stand still before its next step.
    """

    def __init__(
        self,
        session: RunningSession,
        inject: Inject,
        trigger: Callable[[int, int], None] | None = None,
        *,
        can_pause: bool = False,
    ) -> None:
        self._session = session
        self._inject = inject
        self._trigger = trigger
        self._triggers = 0
        self._can_pause = can_pause
        self.status: RunStatus | None = None
        self.paused = False
        self._steps = 0

    def state(self) -> dict[str, Any]:
        """Return what can be asked, and how things stand."""
        return {
            "adjustable": {name: min(value, _LARGEST) for name, value in self._session.adjustable.items()},
            "can_trigger": self._trigger is not None,
            "triggers": self._triggers,
            "can_pause": self._can_pause,
            "paused": self.paused,
        }

    def carry_out(self, command: dict[str, Any]) -> dict[str, Any]:
        """Do what a parsed command says; return {"did": ...} or {"error": ...}."""
        try:
            return self._carried_out(command)
        except ValueError as error:
            return {"error": str(error)}

    def steps_allowed(self) -> bool:
        """Say whether the next step may begin; a single one that was asked for is used up by this."""
        if not self.paused or self._session.stopping:
            return True
        self._steps, allowed = max(self._steps - 1, 0), self._steps > 0
        return allowed

    def _carried_out(self, command: dict[str, Any]) -> dict[str, Any]:
        match command:
            case {"do": "adjust", "name": name, "value": value}:
                self._session.adjust(name, value)
                return {"did": f"{name} = {value:g}"}
            case {"do": "inject", "fault": fault}:
                return self._injected(fault)
            case {"do": "trigger"}:
                return self._triggered()
            case {"do": "pause" | "step" | "resume" as order}:
                return self._ordered(order)
        raise ValueError("this cannot be asked of a run")

    def _injected(self, fault: dict[str, Any]) -> dict[str, Any]:
        if self.status is None:
            raise ValueError("the run has not begun")
        answer = self._inject({"ask": "inject", "fault": fault}, self.status)
        return answer if "error" in answer else {"did": f"{fault.get('kind')} on {answer['link']}"}

    def _triggered(self) -> dict[str, Any]:
        if self._trigger is None:
            raise ValueError("this rig has a [trigger] of its own")
        self._triggers += 1
        self._trigger(time.monotonic_ns(), self._triggers)
        return {"did": f"trigger {self._triggers}"}

    def _ordered(self, order: str) -> dict[str, Any]:
        if not self._can_pause:
            raise ValueError('only a run with pace = "free" that no bus drives can be paused: others follow a clock')
        self.paused = order != "resume"
        self._steps = 1 if order == "step" else 0
        return {"did": {"pause": "paused", "step": "one step", "resume": "resumed"}[order]}
