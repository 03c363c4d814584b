"""Line breaks for people at a terminal, and none for programs: what goes to a file or a pipe has whole lines."""

from __future__ import annotations

import logging

from cyclopts import App
from rich.console import Console

from emulator.cli.output import console, status

__all__ = ["break_lines", "help_console", "log_handler"]

_UNBROKEN = 100_000  # columns


class _WholeLines(logging.Handler):
    """Prints each record of the log as one line on `status`."""

    def emit(self, record: logging.LogRecord) -> None:
        status.print(self.format(record), markup=False)


def break_lines() -> bool:
    """Let `status` break lines at a terminal, and nowhere else; return whether it does."""
    status.soft_wrap = not status.is_terminal
    return status.is_terminal


def log_handler() -> logging.Handler:
    """Return what prints the log on `status`."""
    if status.is_terminal:
        from rich.logging import RichHandler  # loads a tenth of what the command line loads

        return RichHandler(console=status, show_path=False, show_time=False)
    handler = _WholeLines()
    handler.setFormatter(logging.Formatter("%(levelname)-8s %(message)s"))
    return handler


def help_console(app: App) -> Console | None:
    """Set how `app` prints its help, and return where: None for its own console."""
    if console.is_terminal:
        app.help_formatter = "default"
        return None
    app.help_formatter = "plain"  # no boxes
    return Console(width=_UNBROKEN)
