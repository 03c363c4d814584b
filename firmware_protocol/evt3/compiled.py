"""How the loops of this folder are compiled: see `firmware_protocol.compiled`."""

from firmware_protocol.compiled import entry_of, kernel

__all__ = ["entry", "kernel"]

entry = entry_of("firmware_protocol.evt3", "firmware_protocol.edges")
