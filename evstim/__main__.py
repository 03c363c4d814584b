"""`python -m evstim`: the command line."""

from emulator.cli import main

__all__ = ["main"]

if __name__ == "__main__":
    main()
