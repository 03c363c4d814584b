"""The command line: one module for each command; text for people, and JSON for programs with `--json`."""

__all__ = ["main"]


def main() -> None:
    """Run the command line and exit with its code."""
    # Here and not above: a process that imports the script which calls this needs no commands.
    from emulator.cli.app import main as run

    run()
