"""Ports for a program that is started later: none that the kernel gives to others meanwhile.

A port that was bound to 0 and closed is one of the ephemeral range, from which the kernel serves every socket of the
machine, also those of tests that run beside. These are below that range, and each process of tests begins elsewhere.
"""

import itertools
import os
import socket

__all__ = ["free_port"]

_FIRST, _COUNT = 20_000, 9_000  # below 32 768, and none that a shipped rig has
_NUMBERS = itertools.count(os.getpid() * 37)


def free_port(address="127.0.0.1"):
    """Return a port that no TCP and no UDP socket of this machine has at `address`."""
    for _ in range(_COUNT):
        port = _FIRST + next(_NUMBERS) % _COUNT
        if all(_is_free(kind, address, port) for kind in (socket.SOCK_STREAM, socket.SOCK_DGRAM)):
            return port
    raise OSError("no port is free")


def _is_free(kind, address, port):
    with socket.socket(socket.AF_INET, kind) as probe:
        try:
            probe.bind((address, port))
        except OSError:
            return False
    return True
