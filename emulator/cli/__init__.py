"""The command line: one module for each command; text for people, and JSON for programs with `--json`."""

__all__ = ["main"]


def main() -> None:
    """Run the command line and exit with its code."""
    # Imported here: each link's process begins by importing the script that calls this, and needs no verbs.
    from emulator.run.standard_descriptors import fill_standard_descriptors

    fill_standard_descriptors()
    from emulator.cli.signals import exit_on_stop_signals, interrupt_on_stop_signals

    exit_on_stop_signals()
    from emulator.cli.app import main as run

    interrupt_on_stop_signals()
    run()
