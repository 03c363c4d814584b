"""The spacecraft: dynamics that take commands from the CAN bus, tell attitudes there, and send poses to the camera.

Each turn of 0.2 s: the equations are integrated, a pose and an attitude are sent for each picture of the turn, then the
SYNC lets the camera's time go on. The command that answers it holds for the next turn: computing takes one turn of
simulated time, however long it takes here.
"""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from dataclasses import dataclass

import can
import numpy as np
from frames import ATTITUDE, COMMAND, SYNC, pack_attitude, unpack_command
from vehicle import GRAVITY_M_S2, Lander, State, advance, product

from firmware_protocol.pose_message import PoseMessage

__all__ = ["NoAnswer", "Spacecraft", "TouchDown"]

_PICTURE_S = 0.04
_PICTURES = 5
_ANSWER_S = 120.0
_FOOT_M = 2.0  # height of the camera when the feet stand
_LONGEST_S = 600.0
_LOOKING_DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # body from camera


@dataclass(frozen=True)
class TouchDown:
    """How a flight ended."""

    t_s: float
    state: State
    touched: bool
    fuel_kg: float

    @property
    def vertical_m_s(self) -> float:
        """Speed into the ground."""
        return -float(self.state.velocity_m_s[2])

    @property
    def horizontal_m_s(self) -> float:
        """Speed along the ground."""
        return float(np.hypot(*self.state.velocity_m_s[:2]))


class NoAnswer(RuntimeError):
    """The flight computer has not answered a SYNC."""


class Spacecraft:
    """One vehicle on one bus.

    Parameters
    ----------
    lander, state : figures and start.
    bus : the CAN bus.
    poses : where the camera takes poses, (host, port).
    """

    def __init__(self, lander: Lander, state: State, bus: can.BusABC, poses: tuple[str, int]) -> None:
        self._lander, self.state = lander, state
        self._full_kg = state.mass_kg
        self._bus, self._poses = bus, poses
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._number = self._turn = 0
        self._tell()

    def land(self, ground_m: Callable[[float, float], float], told: Callable[[float, State], None]) -> TouchDown:
        """Fly to the ground, whose height is told by place, telling time and state of each turn; raises NoAnswer."""
        command = np.array([0.0, 0.0, GRAVITY_M_S2])
        while self.t_s < _LONGEST_S:
            for _ in range(_PICTURES):
                self.state = advance(self._lander, self.state, command, _PICTURE_S)
                self._number += 1
                x, y, z = self.state.position_m.tolist()
                if z - ground_m(x, y) <= _FOOT_M:
                    return self._end(touched=True)
                self._tell()
            self._turn += 1
            self._send(SYNC, b"")
            told(self.t_s, self.state)
            command = self._answer()
        return self._end(touched=False)

    def _end(self, *, touched: bool) -> TouchDown:
        return TouchDown(self.t_s, self.state, touched, self._full_kg - self.state.mass_kg)

    @property
    def t_s(self) -> float:
        """Time of the newest pose."""
        return self._number * _PICTURE_S

    def _tell(self) -> None:
        """Send pose and attitude of now."""
        q = product(self.state.attitude, _LOOKING_DOWN)
        t_ns = round(self.t_s * 1e9)
        pose = PoseMessage(t_ns, tuple(self.state.position_m), tuple(q), counter=self._number)
        self._socket.sendto(bytes(pose), self._poses)
        self._send(ATTITUDE, pack_attitude(self.state.attitude, self._number))

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))

    def _answer(self) -> np.ndarray:
        """Return the command that answers this turn's SYNC."""
        end_s = time.monotonic() + _ANSWER_S
        while (left_s := end_s - time.monotonic()) > 0:
            message = self._bus.recv(left_s)
            if message is not None and message.arbitration_id == COMMAND:
                command, turn = unpack_command(bytes(message.data))
                if turn == self._turn % (1 << 16):
                    return command
        raise NoAnswer(f"the flight computer has not answered SYNC {self._turn} within {_ANSWER_S:g} s")
