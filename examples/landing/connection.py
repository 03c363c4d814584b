"""Links of the spacecraft: poses by UDP; attitudes, SYNCs and commands on the CAN bus."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable

import can
import numpy as np
from faults import Faults
from frames import ATTITUDE, COMMAND, ESTIMATE, SYNC, pack_attitude, unpack_command
from vehicle import State, product

from firmware_protocol.pose_message import PoseMessage

__all__ = ["Connection"]

_LOOKING_DOWN = np.array([0.0, 1.0, 0.0, 0.0])  # body from camera
_POLL_S = 0.5


class Connection:
    """The spacecraft's side of its links.

    Parameters
    ----------
    bus : the CAN bus.
    poses : address at which the camera receives poses, (host, port).
    trouble : returns a text that names the process that has ended; "" while all run.
    faults : injected faults.
    """

    def __init__(
        self, bus: can.BusABC, poses: tuple[str, int], trouble: Callable[[], str], faults: Faults | None = None
    ) -> None:
        self._bus, self._poses, self.trouble = bus, poses, trouble
        self._faults = faults or Faults()
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._counter = 0
        self._estimate = b""

    def pose(self, t_s: float, state: State) -> None:
        """Send the pose of the camera at a stream time."""
        q = product(state.attitude, _LOOKING_DOWN)
        message = PoseMessage(round(t_s * 1e9), tuple(state.position_m), tuple(q), counter=self._counter)
        self._counter += 1
        if (data := self._faults.datagram(message, t_s)) is not None:
            self._socket.sendto(data, self._poses)

    def attitude(self, t_s: float, state: State, number: int) -> None:
        """Send the attitude of a time, which has a number."""
        if not self._faults.loses_frame(t_s):
            self._send(ATTITUDE, pack_attitude(state.attitude, number))

    def frame(self, t_s: float, identifier: int, data: bytes) -> None:
        """Send a frame of a sensor."""
        if not self._faults.loses_frame(t_s):
            self._send(identifier, data)

    def sync(self, counter: bytes = b"") -> None:
        """Send a SYNC."""
        self._send(SYNC, counter)

    def command(self, t_s: float, limit_s: float) -> tuple[np.ndarray, int] | None:
        """Return the next command and the turn that it answers; None when the bus lost it.

        Raises TimeoutError when none comes within `limit_s` of wall time, or when there is trouble.
        """
        end_s = time.monotonic() + limit_s
        while (left_s := end_s - time.monotonic()) > 0 and not self.trouble():
            message = self.receive(min(left_s, _POLL_S))
            if message is not None and message.arbitration_id == ESTIMATE:
                self._estimate = bytes(message.data)
            if message is not None and message.arbitration_id == COMMAND:
                return None if self._faults.loses_frame(t_s) else unpack_command(bytes(message.data))
        raise TimeoutError

    def answer(self, t_s: float, limit_s: float) -> tuple[np.ndarray, int, bytes] | None:
        """Return the next command, its turn, and the data of the newest estimate; see `command`."""
        answer = self.command(t_s, limit_s)
        return None if answer is None else (*answer, self._estimate)

    def receive(self, timeout_s: float) -> can.Message | None:
        """Return the next frame of the bus, if one comes in time."""
        return self._bus.recv(timeout_s)

    def loses(self, t_s: float) -> bool:
        """Return whether the bus loses the command that came."""
        return self._faults.loses_frame(t_s)

    def _send(self, identifier: int, data: bytes) -> None:
        self._bus.send(can.Message(arbitration_id=identifier, data=data, is_extended_id=False))
