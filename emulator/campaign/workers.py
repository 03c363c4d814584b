"""Runs of a campaign in worker processes on this machine, each of which does many runs.

`Workers` is any pool of workers, here or on a cluster (`on_dask`). `run_campaign` does the runs, and writes each row as
it comes. A worker, `python -m emulator.campaign.workers`, takes orders over a socket:

    orders, JSON:   {"source": {...}, "folder": ..., "threads": 1}     once
                    {"index": 17, "worker": 0}                         for each run
    answers, JSON:  {"ready": true}                                    once
                    {"row": {...}} | {"stopped": "why the campaign cannot go on"} | {"abandoned": true}

It ends when the socket is closed. SIGTERM abandons the present run; it comes also when the parent process dies.
"""

from __future__ import annotations

import ctypes
import gc
import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Callable, Generator, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import closing, suppress
from dataclasses import asdict
from functools import partial
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any

from emulator.campaign.campaign import Campaign, Row, judged, parameter_columns
from emulator.campaign.loading import CampaignError, Source
from emulator.campaign.one_run import CampaignStopped, Place, end_leftover, run_folder, run_row
from emulator.campaign.table import done_rows, rows_folder, write_row
from emulator.rig.loading import RigError
from emulator.run.session import Session

_TRIES = 3
_STARTS = 10
_START_TIMEOUT_S = 300.0  # a worker loads kernels from disk when it starts; long on a busy machine


class Abandoned(Exception):
    """The run was given up because the campaign ends."""


class WarmWorker:
    """A process that does runs of one campaign; it is started when it is needed, and again when it dies.

    Parameters
    ----------
    threads : of the pixel step, where the rig does not give their number.
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
        message = f"the worker ended in each of {_TRIES} tries: {', '.join(ends)}"
        return lost_row(self._campaign, index, "crashed", message)

    def _started(self) -> Connection:
        """Return the socket of a worker that is ready; raises CampaignStopped where none can start."""
        ends: list[str] = []
        while len(ends) < _STARTS:
            if self._closing:
                raise Abandoned
            try:
                return self._socket or self._start()
            except (EOFError, OSError) as error:  # among them TimeoutError
                end = self._end_of_worker()
                ends.append(str(error) or end)
        raise CampaignStopped(f"worker processes do not start: {', '.join(sorted(set(ends)))}")

    def _once(self, socket: Connection, index: int, number: int) -> Row:
        socket.send_bytes(json.dumps({"index": index, "worker": number}).encode())
        answer = _answer(socket, self._campaign.settings.timeout_s)
        if "row" not in answer:  # it received SIGTERM, from `abandon` or from another program
            raise EOFError
        row: Row = answer["row"]
        return row

    def _start(self) -> Connection:
        parent_end, child_end = socket.socketpair()
        with child_end:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "emulator.campaign.workers", str(child_end.fileno())],
                pass_fds=[child_end.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "LP_NUM_THREADS": str(self._threads), "PYTHONPATH": os.pathsep.join(sys.path)},
            )
        self._socket = Connection(parent_end.detach())
        setup = {"source": asdict(self._campaign.source), "folder": str(self._folder), "threads": self._threads}
        self._socket.send_bytes(json.dumps(setup).encode())
        _answer(self._socket, _START_TIMEOUT_S)
        return self._socket

    def _end_of_worker(self, index: int | None = None) -> str:
        """Clean up after a worker that has died, with a run or without, and return its signal or exit code."""
        code = self._kill(index)
        return signal.Signals(-code).name if code < 0 else f"exit code {code}"

    def _kill(self, index: int | None) -> int:
        """End the process, where there is one, and what a run has left; return its exit code."""
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

    def abandon(self, number: int = signal.SIGTERM) -> None:
        """End the present run without a row, by SIGKILL at once; for another thread."""
        self._closing = True
        if self._process is not None:
            with suppress(ProcessLookupError):
                self._process.send_signal(number)

    def close(self, patience_s: float = 10.0) -> None:
        """End the process, which has no run now."""
        if self._socket is not None:
            self._socket.close()
        if self._process is not None:
            with suppress(subprocess.TimeoutExpired):
                self._process.wait(patience_s)
        self._kill(None)


def _answer(socket: Connection, timeout_s: float) -> dict[str, Any]:
    if not socket.poll(timeout_s):
        raise TimeoutError
    answer: dict[str, Any] = json.loads(socket.recv_bytes())
    if "stopped" in answer:
        raise CampaignStopped(answer["stopped"])
    return answer


def lost_row(campaign: Campaign, index: int, outcome: str, error: str) -> Row:
    """Return the row of a run that did not reach its end."""
    row: Row = {"index": index, "campaign": campaign.id, "outcome": outcome, "error": error}
    row |= {"seed": campaign.seed(index), **parameter_columns(campaign.values(index))}
    return judged(campaign.settings, row)


_PATIENCE_S = 10.0


class Workers(ABC):
    """Pool that does runs, each under a number that no other run has at the same time: {worker} of a rig."""

    def __init__(self) -> None:
        self._news: SimpleQueue[tuple[int, Any] | None] = SimpleQueue()

    def rows(self, indices: Iterable[int]) -> Generator[Row]:
        """Do the runs and yield their rows as they come, in any order; end after `stop`. Raises CampaignStopped."""
        waiting, working = iter(indices), dict[int, int]()  # index of the run by its number
        try:
            free = [*reversed(range(self._size()))]
            self._begin(waiting, free, working)
            while working and (news := self._news.get()) is not None:
                number, future = news
                index = working.pop(number)
                free.append(number)
                row = self._row(future, index)
                self._begin(waiting, free, working)
                yield row
        finally:
            self._close()

    def stop(self) -> None:
        """Begin no further run, and take no further row; for a signal handler."""
        self._news.put(None)

    def _begin(self, waiting: Iterator[int], free: list[int], working: dict[int, int]) -> None:
        """Begin runs while there are free numbers."""
        while free and (index := next(waiting, None)) is not None:
            number = free.pop()
            working[number] = index
            self._submit(index, number).add_done_callback(partial(self._done, number))

    def _done(self, number: int, future: Any) -> None:
        self._news.put((number, future))

    @abstractmethod
    def _size(self) -> int:
        """Return the number of runs that may be in progress at once."""

    @abstractmethod
    def _submit(self, index: int, number: int) -> Any:
        """Begin a run, and return its future."""

    @abstractmethod
    def _row(self, future: Any, index: int) -> Row:
        """Return the row of a run that is done; raises CampaignStopped."""

    @abstractmethod
    def _close(self) -> None:
        """End the workers, and the runs in progress without a row."""


class LocalWorkers(Workers):
    """Workers on this machine, each in a process of its own."""

    def __init__(self, workers: list[WarmWorker]) -> None:
        super().__init__()
        self._workers = workers
        self._threads = ThreadPoolExecutor(len(workers))

    def stop(self, number: int = signal.SIGTERM) -> None:
        """Begin no further run, and abandon those in progress; for a signal handler."""
        super().stop()  # first: no row of an abandoned run is taken
        for worker in self._workers:
            worker.abandon(number)

    def _size(self) -> int:
        return len(self._workers)

    def _submit(self, index: int, number: int) -> Future[Row]:
        return self._threads.submit(self._workers[number].run, index, number)

    def _row(self, future: Future[Row], index: int) -> Row:
        return future.result()

    def _close(self) -> None:
        """Return when no worker is left; those that do not end their run in time are killed."""
        self.stop()
        timer = threading.Timer(_PATIENCE_S, self.stop, [signal.SIGKILL])
        timer.start()
        self._threads.shutdown()
        for worker in self._workers:
            worker.close()
        timer.cancel()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


def part_of(text: str, runs: int) -> range:
    """Return the runs of a job of a job array: for "3/10" every tenth, from 2 on; raises ValueError."""
    match = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not match or not 1 <= int(match[1]) <= int(match[2]):
        raise ValueError(f"expected I/N with I from 1 to N, such as 3/10, got {text!r}")
    return range(int(match[1]) - 1, runs, int(match[2]))


def remaining(folder: Path, indices: Iterable[int]) -> list[int]:
    """Return those of the wanted runs that have no row yet."""
    done = done_rows(rows_folder(folder))
    return [index for index in indices if index not in done]


def run_campaign(
    campaign: Campaign, folder: Path, indices: Iterable[int], workers: Workers, on_row: Callable[[Row], None]
) -> None:
    """Do runs, and write each row when it comes; raises CampaignStopped, and written rows stay."""
    with closing(workers.rows(indices)) as rows:
        for row in rows:
            try:
                write_row(rows_folder(folder), row)
            except OSError as error:
                lost = f"the row of run {row['index']} of {campaign.name} was not written"
                raise CampaignStopped(f"{folder}: {error.strerror or error}: {lost}") from error
            on_row(row)


_PR_SET_PDEATHSIG = 1


class _Worker:
    """Loop of a worker over the runs of one campaign."""

    def __init__(self, socket: Connection) -> None:
        self._socket = socket
        self._session: Session | None = None
        self._abandoned = False

    def serve(self) -> None:
        """Answer orders until the other side disconnects."""
        setup = json.loads(self._socket.recv_bytes())
        try:
            campaign = Campaign(Source(**setup["source"]))
        except (CampaignError, RigError) as error:
            self._answer({"stopped": str(error)})
            return
        gc.freeze()  # loaded modules stay: no collection need examine them again
        self._answer({"ready": True})
        while not self._abandoned:
            order = json.loads(self._socket.recv_bytes())
            place = Place(Path(setup["folder"]), order["worker"], setup["threads"])
            self._answer(self._done(campaign, order["index"], place))

    def _done(self, campaign: Campaign, index: int, place: Place) -> dict[str, object]:
        try:
            row = run_row(campaign, index, place, self._take)
        except CampaignStopped as error:
            return {"stopped": str(error)}
        return {"abandoned": True} if self._abandoned else {"row": row}

    def _take(self, session: Session) -> None:
        self._session = session
        if self._abandoned:
            session.stop()

    def _answer(self, message: dict[str, object]) -> None:
        self._socket.send_bytes(json.dumps(message).encode())

    def abandon(self, *_: object) -> None:
        """End the present run after its present step, without a row."""
        self._abandoned = True
        if self._session is not None:
            self._session.stop()


def main() -> None:
    """Do runs in this process, by orders over the socket whose number is the first argument."""
    descriptor = int(sys.argv[1])
    os.set_inheritable(descriptor, False)
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the parent process
    signal.signal(signal.SIGHUP, signal.SIG_IGN)
    worker = _Worker(Connection(descriptor))
    signal.signal(signal.SIGTERM, worker.abandon)
    with suppress(AttributeError, OSError):  # SIGTERM also when the parent process dies: the run must then not go on
        ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    with suppress(EOFError, BrokenPipeError, ConnectionResetError):  # the other side has disconnected
        worker.serve()


if __name__ == "__main__":
    main()
