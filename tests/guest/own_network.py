"""A network of a test's own, with nothing but a loopback interface: searches by broadcast stay in it."""

import os
import subprocess

import pytest

__all__ = ["CAMERA", "HOST", "OwnNetwork"]

CAMERA, HOST = "10.77.0.1", "10.77.0.2"
"""Addresses of the two ends of a cable."""

_HOLD = "ip link set lo up && echo up && exec cat"


class OwnNetwork:
    """A network namespace that lasts until the block ends; `inside` prefixes a command that runs in it."""

    def __enter__(self):
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

    def inside(self, *command):
        """Return the command that runs `command` in this network."""
        user = [] if os.geteuid() == 0 else ["--user", "--preserve-credentials"]
        return ["nsenter", "--target", str(self._holder.pid), *user, "--net", *command]

    def run(self, *command):
        """Run a command in this network; skips the test where that fails."""
        done = subprocess.run(self.inside(*command), capture_output=True, text=True)
        if done.returncode != 0:
            pytest.skip(f"{' '.join(command)}: {done.stderr.strip()}")

    def join(self, other, ours, theirs):
        """Lay a cable, for packets of 9000 octets, to another network; each end gets an address of a /24."""
        pair = ("cable", "type", "veth", "peer", "name", "cable", "netns", str(other._holder.pid))
        self.run("ip", "link", "add", *pair)
        for end, address in ((self, ours), (other, theirs)):
            end.run("ip", "address", "add", f"{address}/24", "broadcast", "+", "dev", "cable")
            end.run("ip", "link", "set", "cable", "mtu", "9000", "up")

    def __exit__(self, *_):
        self._holder.communicate()
