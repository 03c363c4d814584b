"""What the tests of full disks share."""

import subprocess

import pytest


@pytest.fixture
def disk_of(tmp_path):
    """Make a disk of so many octets, in words of mount; only root can."""
    folder = tmp_path / "tiny"

    def make(size):
        folder.mkdir()
        command = ["mount", "-t", "tmpfs", "-o", f"size={size}", "none", folder]
        made = subprocess.run(command, capture_output=True, check=False)
        if made.returncode:
            pytest.skip(f"this user cannot mount a tmpfs: {made.stderr.decode().strip()}")
        return folder

    yield make
    if folder.is_mount():
        subprocess.run(["umount", folder], check=True)
