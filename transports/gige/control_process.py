"""The link's side of the process that answers hosts: it is started, gives orders, and is told the device's clock.

the link -- ControlSetup, Stop --> transports.gige.answering
         -- device's clock ------>     (shared memory)
         <-- Listening, orders, counts
"""

from __future__ import annotations

import mmap
import os
import socket
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from multiprocessing.connection import Connection
from firmware_protocol.gige.orders import DeviceTime, Order
from transports.gige.answering import TIME_CELLS, ControlSetup, Failed, Listening, Stop
from transports.link.endpoint import LinkBroken

__all__ = ["ControlProcess"]

_START_S = 120.0  # on a machine that is very busy
_END_S = 10.0
_AT_A_TIME = 1024
_MAIN = "from transports.gige.answering import main; main()"
_TIME = struct.Struct("=q")


class ControlProcess:
    """A camera's control channel in a process of its own.

    Raises OSError, with what to do, when it cannot be started or an address cannot be used.

    Attributes
    ----------
    counts
        Requests by what became of them.
    port
        Where it listens.
    """

    def __init__(self, setup: ControlSetup) -> None:
        memory = os.memfd_create("evstim-gige-time")
        os.ftruncate(memory, 8 * TIME_CELLS)
        self._time = mmap.mmap(memory, 8 * TIME_CELLS)
        ours, theirs = socket.socketpair()
        self._connection = Connection(ours.detach())
        self._process = _started(theirs.fileno(), memory)
        theirs.close()
        os.close(memory)
        self.counts: Counter[str] = Counter()
        self._connection.send(setup)
        self.port = self._listening()

    def take(self) -> Iterator[Order]:
        """Give what has been ordered; raises LinkBroken when the process has died."""
        for _ in range(_AT_A_TIME):
            try:
                if not self._connection.poll():
                    return
                told = self._connection.recv()
            except (EOFError, ConnectionError) as error:
                how = f"exit code {self._process.wait(_END_S)}"
                raise LinkBroken(f"the process that answers GigE Vision hosts has died ({how})") from error
            if isinstance(told, Counter):
                self.counts = told
            else:
                yield told

    def tell(self, time: DeviceTime) -> None:
        """Say what the device's clock is: see `read_time`."""
        _TIME.pack_into(self._time, 8, time.ns)
        _TIME.pack_into(self._time, 0, time.starts)

    def close(self) -> None:
        """End it; its last counts are taken, orders that wait are not."""
        try:
            self._connection.send(Stop())
            while True:
                told = self._connection.recv()
                self.counts = told if isinstance(told, Counter) else self.counts
        except (EOFError, ConnectionError):
            self._connection.close()
        self._process.kill()
        self._process.wait()
        self._time.close()

    def _listening(self) -> int:
        """Return the port; raises OSError when there is none."""
        try:
            told = self._connection.recv() if self._connection.poll(_START_S) else None
        except EOFError:
            told = None
        if isinstance(told, Listening):
            return told.port
        self._process.kill()
        self._process.wait()
        self._connection.close()
        if isinstance(told, Failed):
            raise OSError(told.errno, told.told)
        raise OSError("the process that answers GigE Vision hosts does not start; what it says is above")


def _started(connection: int, memory: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [sys.executable, "-c", _MAIN, str(connection), str(memory)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=(connection, memory),
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )
