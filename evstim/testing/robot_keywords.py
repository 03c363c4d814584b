"""Keywords for Robot Framework over the same runs as the pytest plugin.

    *** Settings ***
    Library    evstim.testing.robot_keywords.RobotKeywords

    *** Test Cases ***
    The Decoder Reads The Camera
        ${address} =    Start Rig    serial-demo    seed=7
        Run Process    my-decoder    ${address}
        Inject Fault    bit_flips    rate=1e-5    for_s=0.5
        ${result} =    Stop Rig

`Stop Rig` fails when the ledger does not balance or a link failed. A rig that still runs at the end of a test case is
stopped. Robot Framework itself is not needed to import this module.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

from emulator.run.outcome import RunResult
from evstim.testing.running_rig import RigOptions, RunningRig, faults_of_a_run
from transports.output_file import TemporaryFolder


class RobotKeywords:
    """One rig at a time."""

    ROBOT_LIBRARY_SCOPE = "TEST"
    ROBOT_LISTENER_API_VERSION = 3

    def __init__(self) -> None:
        self.ROBOT_LIBRARY_LISTENER = self
        self._rig: RunningRig | None = None
        self._folder: TemporaryFolder | None = None

    def start_rig(self, rig: str, **options: Any) -> str | None:
        """Start a rig on free ports and return the address of its first link; options as of the pytest mark `rig`."""
        if self._rig is not None:
            raise RuntimeError("a rig is running already: use Stop Rig first")
        self._folder = TemporaryFolder("robot")
        started = RunningRig(rig, Path(self._folder.name), RigOptions(**_values(options)))
        started.__enter__()
        self._rig = started
        return next(iter(started.addresses.values()), None)

    def stop_rig(self) -> RunResult:
        """Stop the rig, fail when its ledger does not balance or a link failed, and return its result."""
        result = self._running().stop()
        self._forget()
        if wrong := faults_of_a_run(result):
            raise AssertionError("\n".join(wrong))
        return result

    def link_address(self, name: str) -> str | None:
        """Return where the other side of a link is."""
        return self._running().addresses[name]

    def inject_fault(self, kind: str, **keys: Any) -> None:
        """Begin a fault; `keys` are those of a rig's [[faults]] table."""
        self._running().inject(kind, **_values(keys))

    def events_read_out(self) -> int:
        """Return how many events the sensor has read out so far."""
        return self._running().status.read_out

    def end_test(self, data: object, result: object) -> None:
        """Stop a rig that is running at the end of a test case: Robot Framework calls this."""
        if self._rig is not None:
            self._rig.stop()
            self._forget()

    def _running(self) -> RunningRig:
        if self._rig is None:
            raise RuntimeError("no rig is running: use Start Rig first")
        return self._rig

    def _forget(self) -> None:
        self._rig = None
        if self._folder is not None:
            self._folder.cleanup()
            self._folder = None


def _values(texts: dict[str, Any]) -> dict[str, Any]:
    """Return arguments, which Robot Framework writes as text, as numbers where they are some."""
    return {key: _value(value) for key, value in texts.items()}


def _value(text: Any) -> Any:
    try:
        return ast.literal_eval(text) if isinstance(text, str) else text
    except (ValueError, SyntaxError):
        return text
