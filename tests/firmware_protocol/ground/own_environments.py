"""Pythons that have what cannot share an environment with evstim: made for a test, or named by the environment."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

__all__ = ["python_with"]


def python_with(package, variable, folder):
    """Return a Python that has `package`; skip, with the reason, where it can neither be found nor installed.

    `package` may name several, with spaces between.
    """
    if named := os.environ.get(variable):
        return Path(named)
    subprocess.run([sys.executable, "-m", "venv", "--without-pip", folder], check=True)
    python = folder / "bin" / "python"
    install = [sys.executable, "-m", "pip", "--python", folder, "install", "--no-compile", "--quiet", *package.split()]
    done = subprocess.run(install, capture_output=True, text=True)
    if done.returncode:
        pytest.skip(
            f"{package} cannot be installed here, and {variable} names no Python that has it: {done.stderr[-300:]}"
        )
    return python
