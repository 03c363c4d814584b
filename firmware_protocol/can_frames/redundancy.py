"""Which of two buses to use: the master's heartbeat decides (ECSS-E-ST-50-15C, section 4.8; SpaceCAN).

A camera starts on its default bus. When the master's heartbeat has been missing there for `heartbeat_ms`, it turns to
the other one, and while it hears none, again every `toggle_ms`. After `toggles` turns in vain it goes back to its
default bus and stays, until a heartbeat comes there; then all begins anew.
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["BusSelector", "SelectorSettings"]


@dataclass(frozen=True)
class SelectorSettings:
    """When to change buses.

    Attributes
    ----------
    default
        0 for bus A, 1 for bus B.
    heartbeat_ms
        Consumer heartbeat time: how long the master may be silent.
    toggle_ms
        T_toggle: how long to listen on a bus while searching.
    toggles
        N_toggle: turns in vain before resting on the default bus; 0: search without end.
    """

    default: int = 0
    heartbeat_ms: int = 2000
    toggle_ms: int = 2000
    toggles: int = 8

    def __post_init__(self) -> None:
        if self.default not in (0, 1):
            raise ValueError(f"default must be 0 (bus A) or 1 (bus B), got {self.default}")
        if self.heartbeat_ms < 1 or self.toggle_ms < 1 or self.toggles < 0:
            raise ValueError("heartbeat_ms and toggle_ms must be positive and toggles not negative")


class BusSelector:
    """Follows the master from bus to bus; `active` is 0 or 1."""

    def __init__(self, settings: SelectorSettings, now_ns: int) -> None:
        self._settings = settings
        self.active = settings.default
        self.turns = 0
        self._in_vain = 0
        self._deadline_ns: int | None = now_ns + settings.heartbeat_ms * 1_000_000

    @property
    def resting(self) -> bool:
        """True when the search was given up."""
        return self._deadline_ns is None

    def heartbeat(self, bus: int, now_ns: int) -> None:
        """Take a heartbeat of the master; on the bus that is not in use it goes unheard."""
        if bus == self.active:
            self._in_vain = 0
            self._deadline_ns = now_ns + self._settings.heartbeat_ms * 1_000_000

    def poll(self, now_ns: int) -> bool:
        """Let time pass; returns True when this changed the bus in use."""
        if self._deadline_ns is None or now_ns < self._deadline_ns:
            return False
        before = self.active
        if self._settings.toggles and self._in_vain >= self._settings.toggles:
            self.active, self._deadline_ns = self._settings.default, None
        else:
            self.active = 1 - self.active
            self._in_vain += 1
            self._deadline_ns = now_ns + self._settings.toggle_ms * 1_000_000
        self.turns += self.active != before
        return self.active != before
