"""Clean end of a run at Ctrl-C (SIGINT) and at a service manager's SIGTERM."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from contextlib import contextmanager

from emulator.run.session import Session

__all__ = ["stopped_by_signals"]

_SIGNALS = (signal.SIGINT, signal.SIGTERM)


@contextmanager
def stopped_by_signals(session: Session) -> Iterator[None]:
    """Let SIGINT and SIGTERM end the session after its present step; a second one interrupts at once."""

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
