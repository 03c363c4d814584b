"""Clean end of a run at Ctrl-C (SIGINT) and at a service manager's SIGTERM."""

from __future__ import annotations

import os
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Protocol

__all__ = ["exit_on_stop_signals", "interrupt_on_stop_signals", "stopped_by_signals"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)


class _Session(Protocol):
    def stop(self) -> None:
        """End the run after the present step."""


def exit_on_stop_signals() -> None:
    """Let signals that stop a run end the process at once: while it is imported there is nothing to tidy up."""

    def leave(*_: object) -> None:
        os.write(2, b"evstim: interrupted\n")
        os._exit(1)

    for number in _SIGNALS:
        signal.signal(number, leave)


def interrupt_on_stop_signals() -> None:
    """Let SIGTERM and SIGHUP do what Ctrl-C does."""
    for number in _SIGNALS:
        signal.signal(number, signal.default_int_handler)


@contextmanager
def stopped_by_signals(session: _Session) -> Iterator[None]:
    """Let SIGINT, SIGTERM and SIGHUP end the session after its present step; a second one interrupts at once."""

    def stop(*_: object) -> None:
        session.stop()
        for number in _SIGNALS:
            signal.signal(number, signal.default_int_handler)

    before = {number: signal.signal(number, stop) for number in _SIGNALS}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
