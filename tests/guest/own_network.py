"""A network of a test's own, with nothing but a loopback interface: searches by broadcast stay in it."""

from __future__ import annotations

import os
import subprocess

import pytest

__all__ = ["OwnNetwork"]

_HOLD = "ip link set lo up && echo up && exec cat"


class OwnNetwork:
    """A network namespace that lasts until the block ends; `inside` prefixes a command that runs in it."""

    def __enter__(self) -> OwnNetwork:
        unshare = ["unshare", "--net"] if os.geteuid() == 0 else ["unshare", "--map-root-user", "--net"]
        self._holder = subprocess.Popen(
            [*unshare, "sh", "-c", _HOLD],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        assert self._holder.stdout is not None
        if self._holder.stdout.readline() != "up\n":
            _, trouble = self._holder.communicate()
            pytest.skip(f"a network of a test's own cannot be made here: {trouble.strip()}")
        return self

    def inside(self, *command: str) -> list[str]:
        """Return the command that runs `command` in this network."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._holder.pid), *user, "--net", *command]

    def __exit__(self, *_: object) -> None:
        self._holder.communicate()
