"""The programs that `evstim demo` starts to read its camera, each in a process of its own."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass
from json import dumps
from pathlib import Path

from emulator.cli.driver_client import DRIVER, driver_works

__all__ = ["DemoReader", "reader_of"]

_START = "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); from emulator.cli import main; main()"
_DRIVER = (
    "import json, sys; sys.path[:] = json.loads(sys.argv.pop(1)); "
    "from emulator.cli.driver_client import main; sys.exit(main(*sys.argv[1:]))"
)

_Command = Callable[[str, Path, float], list[str]]


@dataclass(frozen=True)
class DemoReader:
    """A reader: what is said of it, and its arguments for a camera's address, a record and a time in seconds."""

    told: str
    arguments: _Command
    code: str = _START

    def start(self, address: str, record: Path, seconds: float) -> subprocess.Popen[bytes]:
        """Start it."""
        command = [sys.executable, "-P", "-c", self.code, dumps(sys.path), *self.arguments(address, record, seconds)]
        return subprocess.Popen(command, stdout=subprocess.DEVNULL)


def _usbip(address: str, record: Path, seconds: float) -> list[str]:
    return ["listen", "--usbip", address, "--seconds", str(seconds), "--record", str(record)]


def _gige(address: str, record: Path, seconds: float) -> list[str]:
    return ["listen", "gige", address, "--seconds", str(seconds), "--record", str(record)]


def _driver(address: str, record: Path, seconds: float) -> list[str]:
    return [address.rpartition(":")[0], str(record), str(seconds)]


def reader_of(kind: str) -> DemoReader:
    """Return what reads a camera on a link of this kind: for GigE Vision a driver that others wrote, if it works."""
    if kind == "usbip":
        return DemoReader("evstim's own receiver", _usbip)
    if driver_works():
        return DemoReader(f"{DRIVER}, unmodified,", _driver, _DRIVER)
    return DemoReader(f"evstim's own receiver (pip install {DRIVER} for a driver that others wrote)", _gige)
