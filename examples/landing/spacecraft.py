"""The spacecraft in lockstep: dynamics with commands and attitudes on the CAN bus, and poses by UDP.

Each turn of 0.2 s: the equations are integrated, a pose and an attitude are sent for each picture of the turn, then the
SYNC lets the camera's time go on. The command that answers it holds for the next turn: computing takes one turn of
simulated time, however long it takes here. A command that the bus lost leaves the last one in force; so does a flight
computer that has died, and the flight goes on to the ground.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from connection import Connection
from vehicle import GRAVITY_M_S2, Lander, State, advance

__all__ = ["FOOT_M", "LEFT_ALONE_S", "USUAL", "Limits", "Spacecraft", "TouchDown", "flies"]

_PICTURE_S = 0.04
_PICTURES = 5
FOOT_M = 2.0  # height of the camera when the feet stand
LEFT_ALONE_S = 60.0  # a flight without commands goes on so long


@dataclass(frozen=True)
class Limits:
    """Wall time within which the flight computer answers, in lockstep; longest flight; s."""

    answer_s: float = 120.0
    longest_s: float = 600.0


USUAL = Limits()


@dataclass(frozen=True)
class TouchDown:
    """End of a flight; `why` lists errors on the way, in words."""

    t_s: float
    state: State
    touched: bool
    fuel_kg: float
    why: tuple[str, ...] = ()

    @property
    def vertical_m_s(self) -> float:
        """Speed into the ground."""
        return -float(self.state.velocity_m_s[2])

    @property
    def horizontal_m_s(self) -> float:
        """Speed along the ground."""
        return float(np.hypot(*self.state.velocity_m_s[:2]))


def flies(state: State) -> bool:
    """Return True when every value of a state is a number."""
    return bool(np.isfinite(state.packed()).all())


class Spacecraft:
    """One vehicle on one bus.

    Parameters
    ----------
    lander, state : parameters and start.
    connection : to camera and flight computer.
    limits : longest waiting times.
    """

    def __init__(self, lander: Lander, state: State, connection: Connection, limits: Limits = USUAL) -> None:
        self._lander, self.state, self._connection, self._limits = lander, state, connection, limits
        self._full_kg = state.mass_kg
        self._number = self._turn = 0
        self._why: list[str] = []
        self._end_s = limits.longest_s
        self._send_pose()

    def land(self, ground_m: Callable[[float, float], float], record: Callable[[float, State], None]) -> TouchDown:
        """Fly to the ground, whose height depends on the place; `record` receives time and state of each turn."""
        command = np.array([0.0, 0.0, GRAVITY_M_S2])
        while self.t_s < self._end_s:
            for _ in range(_PICTURES):
                state = advance(self._lander, self.state, command, _PICTURE_S)
                if not flies(state):
                    self._why.append(f"the dynamics gave no numbers at {self.t_s:.2f} s")
                    return self._end(touched=False)
                self.state = state
                self._number += 1
                x, y, z = state.position_m.tolist()
                if z - ground_m(x, y) <= FOOT_M:
                    return self._end(touched=True)
                self._send_pose()
            self._turn += 1
            self._connection.sync()
            record(self.t_s, self.state)
            command = self._answer(command)
        self._why.append(f"still flying after {self.t_s:.0f} s")
        return self._end(touched=False)

    def _end(self, *, touched: bool) -> TouchDown:
        return TouchDown(self.t_s, self.state, touched, self._full_kg - self.state.mass_kg, tuple(self._why))

    @property
    def t_s(self) -> float:
        """Time of the newest pose."""
        return self._number * _PICTURE_S

    def _send_pose(self) -> None:
        """Send pose and attitude of now."""
        self._connection.pose(self.t_s, self.state)
        self._connection.attitude(self.t_s, self.state, self._number)

    def _answer(self, last: np.ndarray) -> np.ndarray:
        """Return the command that answers this turn's SYNC; the last one where it was lost, or without an answer."""
        if self._why:
            return last
        try:
            while (answer := self._connection.command(self.t_s, self._limits.answer_s)) is not None:
                command, turn = answer
                if turn == self._turn % (1 << 16):
                    return command
        except TimeoutError:
            silent = (
                self._connection.trouble() or f"the flight computer did not answer within {self._limits.answer_s:g} s"
            )
            self._why.append(f"{silent}, at {self.t_s:.1f} s and {self.state.position_m[2]:.1f} m: no command since")
            self._end_s = min(self.t_s + LEFT_ALONE_S, self._end_s)
        return last
