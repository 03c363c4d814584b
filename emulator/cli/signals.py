"""Stop of a command at Ctrl-C (SIGINT), at a service manager's SIGTERM, and at the end of a terminal (SIGHUP).

    signal                          before a run       during a run                 while its summary is written
    first                           interrupts         ends it after this step,     does nothing
                                                       or within it after 0.5 s
    second, within _PATIENCE_S      does nothing       does nothing                 does nothing
    second, later; third            interrupts         ends it within this step     does nothing

A run that ends within a step has its summary too: see `Session.interrupt`.

Before a run the exception would be lost in a callback of compiled code, such as those with which llvmlite loads a
kernel, and an import of compiled code may turn it into another one; numba crashes where it makes the named tuple that a
kernel returns. So the request is noted there, and the exception raised soon after; it is raised again where something
discarded it, and a run does not begin.

One Ctrl-C often arrives twice: from the terminal to the whole process group, and from a wrapper (`uv run`, `make`,
`docker`) that forwards its own. The second must not prevent the summary that follows the first.
"""

from __future__ import annotations

import atexit
import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from contextlib import suppress
from typing import Never

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
_PATIENCE_S = 3.0
_INSISTING = 3  # signals
_AGAIN_S = 0.02
_STEP_S = 0.5  # for a step to end by itself
_LOSING = ("importlib._bootstrap", "_frozen_importlib", "llvmlite.", "numba.core.serialize", "namedtuple_")
"""Beginnings of the names of modules within whose calls an exception is lost, or compiled code crashes by it."""


class StopSignals:
    """Signal handler: the first signal calls `stop`; a third one, or a second one after some seconds, `interrupt`."""

    def __init__(
        self,
        stop: Callable[[], object],
        now_s: Callable[[], float] = time.monotonic,
        interrupt: Callable[[], object] | None = None,
    ) -> None:
        self._stop = stop
        self._interrupt = interrupt or _interrupt
        self._now_s = now_s
        self._count = 0
        self._first_s = 0.0

    def __call__(self, *_: object) -> None:
        """Handle a signal; may raise KeyboardInterrupt."""
        self._count += 1
        if self._count == 1:
            self._first_s = self._now_s()
            self._stop()
        elif self._count >= _INSISTING or self._now_s() - self._first_s >= _PATIENCE_S:
            self._interrupt()


class Interruption:
    """The interrupt of a command before its run; `is_requested`: until something acts on it."""

    is_requested = False

    def __call__(self, *_: object) -> None:
        """Raise KeyboardInterrupt, here or soon after a place where it would be lost."""
        self.is_requested = True
        sys.unraisablehook = self._raise_again
        frames = (frame for frame, _ in traceback.walk_stack(sys._getframe()))
        if not any(str(frame.f_globals.get("__name__")).startswith(_LOSING) for frame in frames):
            _interrupt()
        self._raise_again()

    def _raise_again(self, discarded: sys.UnraisableHookArgs | None = None) -> None:
        """Raise the exception soon; an exception that was `discarded` may be another one."""
        if discarded is not None and not issubclass(discarded.exc_type, KeyboardInterrupt):
            sys.__unraisablehook__(discarded)
        elif self.is_requested:
            signal.signal(signal.SIGALRM, self)
            signal.setitimer(signal.ITIMER_REAL, _AGAIN_S)

    def end(self) -> None:
        """Forget the request."""
        if self.is_requested:
            signal.setitimer(signal.ITIMER_REAL, 0)
        self.is_requested = False


interruption = Interruption()


def exit_on_stop_signals() -> None:
    """Make signals end the process at once: during its imports there is nothing to clean up."""
    _handle(_leave)


def interrupt_on_stop_signals() -> None:
    """Make signals interrupt the command, from now on; raises KeyboardInterrupt as `stop_on_signals`."""
    _handle(StopSignals(interruption))


def stop_on_signals(
    stop: Callable[[], object],
    interrupt: Callable[[], object] | None = None,
    end_step: Callable[[], object] | None = None,
) -> None:
    """Make the first signal call `stop`, such as that of a Session, from now on, and an insistent one `interrupt`.

    This stays so when the run has ended: a second signal may arrive at any moment after the first. `end_step` is called
    by another thread 0.5 s after a signal: handlers wait for the end of a compiled loop of the main thread. Raises
    KeyboardInterrupt where a signal came before and its exception was lost.
    """
    _handle(StopSignals(stop, interrupt=interrupt))
    if end_step is not None:
        reading, writing = os.pipe()
        os.set_blocking(writing, False)
        if (before := signal.set_wakeup_fd(writing, warn_on_full_buffer=False)) >= 0:
            os.close(before)  # ends its thread
        threading.Thread(target=_watch, args=(reading, end_step), daemon=True).start()


def _watch(reading: int, end_step: Callable[[], object]) -> None:
    """Read the numbers of signals as they arrive."""
    while number := os.read(reading, 1):
        if number[0] in _SIGNALS:
            time.sleep(_STEP_S)
            end_step()
    os.close(reading)


def ignore_stop_signals() -> None:
    """Ignore signals from now on: only the summary remains to be written.

    A handler and not SIG_IGN, which programs that are started meanwhile would inherit. When the interpreter ends, it
    replaces handlers by SIG_DFL, but not SIG_IGN: a signal would end it after its summary, with another exit status.
    """
    interruption.end()
    _handle(lambda *_: None)
    atexit.unregister(_ignore_to_the_end)
    atexit.register(_ignore_to_the_end)


def handle_suspension(before: Callable[[], object], after: Callable[[], object]) -> None:
    """Make Ctrl-Z (SIGTSTP) call `before`, stop the process, and call `after` when it goes on; ignored, it stays so."""

    def stop(*_: object) -> None:
        before()
        signal.signal(signal.SIGTSTP, signal.SIG_DFL)
        signal.raise_signal(signal.SIGTSTP)
        handle_suspension(before, after)
        after()

    if signal.getsignal(signal.SIGTSTP) != signal.SIG_IGN:
        signal.signal(signal.SIGTSTP, stop)


def _handle(handler: Callable[..., object] | signal.Handlers) -> None:
    for number in _SIGNALS:
        signal.signal(number, handler)
    if interruption.is_requested:
        _interrupt()


def _ignore_to_the_end() -> None:
    _handle(signal.SIG_IGN)


def _leave(*_: object) -> Never:
    with suppress(OSError):
        os.write(2, b"evstim: interrupted\n")
        os.write(1, b'{"error": "interrupted", "exit_code": 1}\n' if "--json" in sys.argv else b"")
    os._exit(1)


def _interrupt() -> Never:
    raise KeyboardInterrupt
