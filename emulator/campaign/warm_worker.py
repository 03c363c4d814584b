"""The near end of a worker process, which stays warm from one run to the next."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
from contextlib import suppress
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from emulator.campaign.campaign import Campaign
from emulator.campaign.columns import Row, judged, parameter_columns
from emulator.campaign.one_run import CampaignStopped, run_folder
from emulator.campaign.program import end_leftover

__all__ = ["Abandoned", "WarmWorker", "lost_row"]

_TRIES = 3
_STARTS = 10
_START_TIMEOUT_S = 300.0  # a worker loads kernels from disk when it starts; long on a busy machine


class Abandoned(Exception):
    """The run was given up because the campaign ends."""


class WarmWorker:
    """Does runs of one campaign in a process of its own, which is started when it is needed and again when it dies.

    Parameters
    ----------
    threads : of the pixel step, where the rig does not say.
    """

    def __init__(self, campaign: Campaign, folder: Path, threads: int) -> None:
        self._campaign = campaign
        self._folder = folder
        self._threads = threads
        self._process: subprocess.Popen[bytes] | None = None
        self._socket: Connection | None = None
        self._closing = False

    def run(self, index: int, number: int) -> Row:
        """Do a run as worker `number` and return its row; raises CampaignStopped and Abandoned.

        A run whose worker dies is done again, up to three times in all; one that takes too long is not.
        """
        ends: list[str] = []
        while len(ends) < _TRIES:
            socket = self._started()
            try:
                return self._once(socket, index, number)
            except TimeoutError:
                self._kill(index)
                limit_s = self._campaign.settings.timeout_s
                return lost_row(self._campaign, index, "timeout", f"not done after timeout_s = {limit_s:g}")
            except (EOFError, OSError):
                ends.append(self._end_of_worker(index))
            if self._closing:
                raise Abandoned
        told = f"the worker ended in each of {_TRIES} tries: {', '.join(ends)}"
        return lost_row(self._campaign, index, "crashed", told)

    def _started(self) -> Connection:
        """Return the socket of a worker that is ready; raises CampaignStopped where none can start."""
        ends: list[str] = []
        while len(ends) < _STARTS:
            if self._closing:
                raise Abandoned
            try:
                return self._socket or self._start()
            except (EOFError, OSError) as error:  # among them TimeoutError
                told = self._end_of_worker()
                ends.append(str(error) or told)
        raise CampaignStopped(f"worker processes do not start: {', '.join(sorted(set(ends)))}")

    def _once(self, socket: Connection, index: int, number: int) -> Row:
        socket.send_bytes(json.dumps({"index": index, "worker": number}).encode())
        answer = _answer(socket, self._campaign.settings.timeout_s)
        if "row" not in answer:  # it was told to end, by `abandon` or by somebody else
            raise EOFError
        row: Row = answer["row"]
        return row

    def _start(self) -> Connection:
        near, far = socket.socketpair()
        with far:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "emulator.campaign.worker", str(far.fileno())],
                pass_fds=[far.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "LP_NUM_THREADS": str(self._threads), "PYTHONPATH": os.pathsep.join(sys.path)},
            )
        self._socket = Connection(near.detach())
        told = {
            "source": asdict(self._campaign.source),
            "folder": str(self._folder),
            "threads": self._threads,
        }
        self._socket.send_bytes(json.dumps(told).encode())
        _answer(self._socket, _START_TIMEOUT_S)
        return self._socket

    def _end_of_worker(self, index: int | None = None) -> str:
        """Tidy up after a worker that has died, with a run at hand or without, and say how it did."""
        code = self._kill(index)
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def _kill(self, index: int | None) -> int:
        process, socket = self._process, self._socket
        self._process = self._socket = None
        if socket is not None:
            socket.close()
        if process is None:
            return 0
        process.kill()
        code = process.wait()
        if index is not None:
            end_leftover(run_folder(self._folder, index), f"{self._campaign.id}/{index}")
        return code

    def abandon(self) -> None:
        """Let the run at hand end without a row; for another thread."""
        self._closing = True
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.terminate()

    def kill(self) -> None:
        """End the process at once; for another thread."""
        self._closing = True
        if self._process is not None:
            self._process.kill()

    def close(self, patience_s: float = 10.0) -> None:
        """End the process, which has no run at hand."""
        if self._socket is not None:
            self._socket.close()
        if self._process is None:
            return
        try:
            self._process.wait(patience_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process = self._socket = None


def _answer(socket: Connection, timeout_s: float) -> dict[str, Any]:
    if not socket.poll(timeout_s):
        raise TimeoutError
    answer: dict[str, Any] = json.loads(socket.recv_bytes())
    if "stopped" in answer:
        raise CampaignStopped(answer["stopped"])
    return answer


def lost_row(campaign: Campaign, index: int, outcome: str, error: str) -> Row:
    """Return the row of a run that nobody has brought to its end."""
    row: Row = {"index": index, "campaign": campaign.id, "outcome": outcome, "error": error}
    row |= {"seed": campaign.seed(index), **parameter_columns(campaign.values(index))}
    return judged(campaign.settings, row)
