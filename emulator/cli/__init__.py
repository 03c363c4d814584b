"""The command line: one verb for each wish, for people and, with `--json`, for programs."""

from emulator.cli.app import main

__all__ = ["main"]
