"""An FMU in a process of its own, step by step."""

from __future__ import annotations

import importlib.util
import multiprocessing
import signal
from pathlib import Path

from emulator.dynamics.flight import DynamicsError, FlightEnded, Mapping
from emulator.dynamics.fmu_process import serve
from emulator.light import MachineLacks
from emulator.run.link_process import starting_a_process
from transports import Closing
from transports.needs import install_command
from transports.output_file import TemporaryFolder

_START_S = 120.0
_STEP_S = 30.0


class Fmu(Closing):
    """An initialised co-simulation FMU; use it in a `with` block.

    `step` sets the variables `inputs`; `outputs` has the present values of the mapping's outputs, by variable. Raises
    MachineLacks without fmpy; DynamicsError if the file is no FMU that can be used, or lacks a variable; FlightEnded if
    it fails or crashes when it starts.
    """

    def __init__(self, file: Path, mapping: Mapping, inputs: tuple[str, ...] = ()) -> None:
        if importlib.util.find_spec("fmpy") is None:
            raise MachineLacks(f"FMUs need fmpy:  {install_command('fmu')}")
        if not file.is_file():
            raise DynamicsError(f"{file}: no such file")
        self._file, self._names = file, list(dict.fromkeys(mapping.outputs))
        self._folder = TemporaryFolder("fmu")  # outlives a crash of the FMU
        context = multiprocessing.get_context("spawn")
        self._near, child_end = context.Pipe()
        self._process = context.Process(target=serve, args=(child_end,), name=f"FMU {file.name}", daemon=True)
        with starting_a_process(serve):
            self._process.start()
        child_end.close()
        where = {"file": str(file), "folder": self._folder.name}
        content = {**where, "start": mapping.start, "outputs": self._names, "inputs": list(inputs)}
        try:
            self.outputs = self._answer(content, _START_S, "when it starts")
        except BaseException:
            self.close()
            raise

    def step(self, t_s: float, step_s: float, inputs: dict[str, float]) -> None:
        """Set inputs and do one step from `t_s`; raises FlightEnded."""
        self.outputs = self._answer((t_s, step_s, inputs), _STEP_S, f"in its step from {t_s:g} s")

    def _answer(self, message: object, limit_s: float, moment: str) -> dict[str, float]:
        try:
            self._near.send(message)
            if not self._near.poll(limit_s):
                raise FlightEnded(f"{self._file}: the FMU does not answer within {limit_s:g} s {moment}")
            kind, content = self._near.recv()
        except (EOFError, OSError) as error:
            raise FlightEnded(f"{self._file}: the FMU crashed {moment} ({self._end()})") from error
        if kind == "wrong":
            raise DynamicsError(f"{self._file} {content}")
        if kind == "failed":
            raise FlightEnded(f"{self._file}: the FMU failed {moment}: {content}")
        return dict(zip(self._names, content, strict=True))

    def _end(self) -> str:
        self._process.join(10)
        code = self._process.exitcode
        return signal.Signals(-code).name if code is not None and code < 0 else f"exit code {code}"

    def close(self) -> None:
        """End the process, and remove what it has unpacked."""
        self._near.close()
        self._process.join(2)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        self._folder.cleanup()
