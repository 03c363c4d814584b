"""Start of a process of a run, such as a link: whatever the program that starts it, whatever signals come meanwhile."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from multiprocessing import resource_tracker
from typing import Any

from transports.link.process import STOP_SIGNALS, LinkSetup

__all__ = ["starting_a_link", "starting_a_process"]

_FOUND_BY = ("__file__", "__spec__")
_one_at_a_time = threading.Lock()


@contextmanager
def starting_a_link(setup: LinkSetup[Any]) -> Iterator[None]:
    """Start a process within this block that ignores the signals to the session, and needs no main module."""
    with starting_a_process(setup.device, setup.endpoint):
        yield


@contextmanager
def starting_a_process(*parts: object) -> Iterator[None]:
    """Do the same for any process; `parts` are the factories that it is given."""
    with _signals_held_back(), _without_main_module(parts):
        yield


@contextmanager
def _signals_held_back() -> Iterator[None]:
    """Hold back the signals that end a run while a process starts: it inherits that, and ignores them when it can.

    A signal to the whole process group would otherwise end the new process before it could say that it ignores it.
    """
    resource_tracker.ensure_running()  # it unblocks SIGINT and SIGTERM when it starts, so it must run before
    before = signal.pthread_sigmask(signal.SIG_BLOCK, STOP_SIGNALS)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


@contextmanager
def _without_main_module(parts: tuple[object, ...]) -> Iterator[None]:
    """Start a process that does not import the main module again, unless one of `parts` is defined there.

    Else a script that starts a run without `if __name__ == "__main__":`, or one read from standard input, would fail.
    """
    main = sys.modules["__main__"]
    if "__main__" in map(_module_of, parts):
        yield
        return
    with _one_at_a_time:
        hidden: dict[str, Any] = {name: vars(main).pop(name) for name in _FOUND_BY if name in vars(main)}
        main.__spec__ = None
        try:
            yield
        finally:
            vars(main).update(hidden)


def _module_of(part: object) -> str:
    """Return the module in which a factory, or the function in it, is defined."""
    while isinstance(part, partial):
        part = part.func
    return str(getattr(part, "__module__", type(part).__module__))
