"""Interface of a GigE Vision link to the process that answers hosts (`transports.gige.answering`).

the link -- ControlSetup, Stop --> transports.gige.answering
-- device's clock ------>     (shared memory)
<-- master's time ---------
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

from firmware_protocol.gige.control import DeviceTime, Order
from firmware_protocol.ptp.clock import Timebase
from transports.gige.answering import (
    TIME_CELLS,
    ControlSetup,
    Failed,
    Listening,
    Move,
    Mute,
    Release,
    Stop,
    read_timebase,
)
from transports.link.endpoint import LinkBroken

_START_S = 120.0  # enough for a very busy machine
_END_S = 10.0
_AT_A_TIME = 1024
_PIPE_OCTETS = 1 << 20  # holds the orders while a link is not running
_MAIN = "from transports.gige.answering import main; main()"
_TIME = struct.Struct("=q")


class ControlProcess:
    """Control channel of a camera in a separate process.

    Raises OSError, with the remedy, when it cannot be started or an address cannot be used.

    Attributes
    ----------
    counts
        Requests by their result.
    port
        Port of the control channel.
    """

    def __init__(self, setup: ControlSetup) -> None:
        memory = os.memfd_create("evstim-gige-time")
        os.ftruncate(memory, 8 * TIME_CELLS)
        self._time = mmap.mmap(memory, 8 * TIME_CELLS)
        child_in, outgoing = os.pipe()
        incoming, child_out = os.pipe()
        with suppress(OSError):  # beyond this user's limit of pipe memory: a shorter pipe suffices
            fcntl.fcntl(incoming, fcntl.F_SETPIPE_SZ, _PIPE_OCTETS)
        self._outgoing, self._incoming = Connection(outgoing, readable=False), Connection(incoming, writable=False)
        self._process = _started(child_in, child_out, memory)
        for descriptor in (child_in, child_out, memory):
            os.close(descriptor)
        self.counts: Counter[str] = Counter()
        self._timebase: Timebase | None = None
        self._outgoing.send(setup)
        self.port = self._listening()

    @property
    def pid(self) -> int:
        """Number of the process."""
        return self._process.pid

    @property
    def orders(self) -> int:
        """Descriptor that is readable when orders wait."""
        return self._incoming.fileno()

    def take(self) -> Iterator[Order]:
        """Yield the orders of hosts; raises LinkBroken when the process has died, or cannot use its new address."""
        for _ in range(_AT_A_TIME):
            try:
                if not self._incoming.poll():
                    return
                message = self._incoming.recv()
            except (EOFError, ConnectionError) as error:
                how = f"exit code {self._process.wait(_END_S)}"
                raise LinkBroken(f"the process that answers GigE Vision hosts has died ({how})") from error
            if isinstance(message, Failed):
                raise LinkBroken(message.reason)
            if isinstance(message, Counter):
                self.counts = message
            else:
                yield message

    def write_time(self, time: DeviceTime) -> None:
        """Write the device's clock: see `read_time`."""
        _TIME.pack_into(self._time, 8, time.ns)
        _TIME.pack_into(self._time, 0, time.starts)

    @property
    def timebase(self) -> Timebase | None:
        """Relation of a master's time to CLOCK_MONOTONIC; None if the camera follows none."""
        self._timebase = read_timebase(self._time, self._timebase)
        return self._timebase

    def order(self, order: Mute | Release | Move) -> None:
        """Begin or end a fault of the control channel; a dead process is reported by `take`."""
        with suppress(ConnectionError):
            self._outgoing.send(order)

    def close(self) -> None:
        """End the process; its last counts are read, waiting orders are not."""
        try:
            self._outgoing.send(Stop())
            while True:
                message = self._incoming.recv()
                self.counts = message if isinstance(message, Counter) else self.counts
        except (EOFError, ConnectionError):
            self._end()

    def _listening(self) -> int:
        """Return the port; raises OSError when there is none."""
        try:
            message = self._incoming.recv() if self._incoming.poll(_START_S) else None
        except EOFError:
            message = None
        if isinstance(message, Listening):
            return message.port
        self._end()
        if isinstance(message, Failed):
            raise OSError(message.errno, message.reason)
        raise OSError("the process that answers GigE Vision hosts does not start; its output is above")

    def _end(self) -> None:
        self._process.kill()
        self._process.wait()
        self._outgoing.close()
        self._incoming.close()
        self._time.close()


def _started(*descriptors: int) -> subprocess.Popen[bytes]:
    """Start the process in a separate session: Linux divides processors by session (autogroup)."""
    return subprocess.Popen(
        [sys.executable, "-c", _MAIN, *map(str, descriptors)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        pass_fds=descriptors,
        start_new_session=True,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(path or os.getcwd() for path in sys.path)},
    )
