"""How the loops of this folder are compiled: see `firmware_protocol.compiled`."""

from pathlib import Path

from firmware_protocol.compiled import entry_of, kernel

__all__ = ["entry", "kernel"]

entry = entry_of(Path(__file__).parent)
