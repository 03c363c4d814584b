"""The command line: one module for each command; text for people, and JSON for programs with `--json`."""

import gc

__all__ = ["main", "restore_collection"]

_USUAL = gc.get_threshold()
_OBJECTS_WHILE_STARTING = 100_000


def restore_collection() -> None:
    """Collect garbage as often as Python usually does: a run in real time needs short collections."""
    gc.set_threshold(*_USUAL)


def main() -> None:
    """Run the command line and exit with its code."""
    gc.set_threshold(_OBJECTS_WHILE_STARTING)  # what is imported stays, so a search for garbage finds little
    # Imported here: each link's process begins by importing the script that calls this, and needs no verbs.
    from emulator.cli.signals import exit_on_stop_signals

    exit_on_stop_signals()
    from emulator.run import fill_standard_descriptors

    fill_standard_descriptors()
    from emulator.cli.app import main as run

    run()
