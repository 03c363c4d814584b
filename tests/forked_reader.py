"""A reader of a file as a fork of the test: a new interpreter for each file takes most of the time of a test."""

import faulthandler
import os
import signal
import warnings

from transports.guarded_reader import serve

__all__ = ["Fork"]


class Fork:
    """A child process as `guarded_reader` starts it, but a fork."""

    def __init__(self, order):
        with warnings.catch_warnings(action="ignore"):  # Python 3.12 warns of threads, of which the child uses none
            self.pid = os.fork()
        if not self.pid:
            null = os.open(os.devnull, os.O_WRONLY)
            os.dup2(null, 1)
            os.dup2(null, 2)
            faulthandler.disable()  # it writes to a copy of stderr
            try:
                warnings.simplefilter("default")
                serve(order)
            finally:
                os._exit(99)
        self.code = None

    def kill(self):
        if self.code is None:
            os.kill(self.pid, signal.SIGKILL)

    def wait(self):
        """Return the exit code, negative where a signal ended it."""
        if self.code is None:
            self.code = os.waitstatus_to_exitcode(os.waitpid(self.pid, 0)[1])
        return self.code
