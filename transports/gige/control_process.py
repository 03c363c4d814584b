"""The link's side of the process that answers hosts: it is started, gives orders, and is told the device's clock.

the link -- ControlSetup, Stop --> transports.gige.answering
         -- device's clock ------>     (shared memory)
         <-- Listening, orders, counts
"""

from __future__ import annotations

import fcntl
import mmap
import os
import struct
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from multiprocessing.connection import Connection

from firmware_protocol.gige.orders import DeviceTime, Order
from transports.gige.answering import TIME_CELLS, ControlSetup, Failed, Listening, Move, Mute, Release, Stop
from transports.link.endpoint import LinkBroken

__all__ = ["ControlProcess"]

_START_S = 120.0  # on a machine that is very busy
_END_S = 10.0
_AT_A_TIME = 1024
_PIPE_OCTETS = 1 << 20  # orders of a link that stands still for a while
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
        heard, says = os.pipe()
        hears, said = os.pipe()
        with suppress(OSError):  # more pipes than this user may have: a shorter one will do
            fcntl.fcntl(hears, fcntl.F_SETPIPE_SZ, _PIPE_OCTETS)
        self._says, self._hears = Connection(says, readable=False), Connection(hears, writable=False)
        self._process = _started(heard, said, memory)
        for descriptor in (heard, said, memory):
            os.close(descriptor)
        self.counts: Counter[str] = Counter()
        self._says.send(setup)
        self.port = self._listening()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    def take(self) -> Iterator[Order]:
        """Give what has been ordered; raises LinkBroken when the process has died, or cannot be where it is to be."""
        for _ in range(_AT_A_TIME):
            try:
                if not self._hears.poll():
                    return
                told = self._hears.recv()
            except (EOFError, ConnectionError) as error:
                how = f"exit code {self._process.wait(_END_S)}"
                raise LinkBroken(f"the process that answers GigE Vision hosts has died ({how})") from error
            if isinstance(told, Failed):
                raise LinkBroken(told.told)
            if isinstance(told, Counter):
                self.counts = told
            else:
                yield told

    def tell(self, time: DeviceTime) -> None:
        """Say what the device's clock is: see `read_time`."""
        _TIME.pack_into(self._time, 8, time.ns)
        _TIME.pack_into(self._time, 0, time.starts)

    def order(self, word: Mute | Release | Move) -> None:
        """Have a fault of the control channel begin or end; one that has died is told of by `take`."""
        with suppress(ConnectionError):
            self._says.send(word)

    def close(self) -> None:
        """End it; its last counts are taken, orders that wait are not."""
        try:
            self._says.send(Stop())
            while True:
                told = self._hears.recv()
                self.counts = told if isinstance(told, Counter) else self.counts
        except (EOFError, ConnectionError):
            self._end()

    def _listening(self) -> int:
        """Return the port; raises OSError when there is none."""
        try:
            told = self._hears.recv() if self._hears.poll(_START_S) else None
        except EOFError:
            told = None
        if isinstance(told, Listening):
            return told.port
        self._end()
        if isinstance(told, Failed):
            raise OSError(told.errno, told.told)
        raise OSError("the process that answers GigE Vision hosts does not start; what it says is above")

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._says.close()
        self._hears.close()
        self._time.close()


def _started(*descriptors: int) -> subprocess.Popen[bytes]:
    """Start the process in a session of its own: Linux shares processors out by session (autogroup)."""
    return subprocess.Popen(
        [sys.executable, "-c", _MAIN, *map(str, descriptors)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )
