"""Runs of a campaign in worker processes on this machine, each of which does many runs.

A thread for each worker waits for its runs. `run_campaign` does the runs, and writes each row as it comes.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from queue import SimpleQueue
from typing import Any, Protocol

from emulator.campaign.campaign import Campaign, Row, judged, parameter_columns
from emulator.campaign.one_run import CampaignStopped, end_leftover, run_folder
from emulator.campaign.table import done_rows, rows_folder, write_row

__all__ = [
    "Abandoned",
    "LocalWorkers",
    "Part",
    "WarmWorker",
    "Workers",
    "cores",
    "lost_row",
    "part_of",
    "remaining",
    "run_campaign",
]


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
        near, far = socket.socketpair()
        with far:
            self._process = subprocess.Popen(
                [sys.executable, "-P", "-m", "emulator.campaign.worker", str(far.fileno())],
                pass_fds=[far.fileno()],
                stdin=subprocess.DEVNULL,
                env={**os.environ, "LP_NUM_THREADS": str(self._threads), "PYTHONPATH": os.pathsep.join(sys.path)},
            )
        self._socket = Connection(near.detach())
        setup = {
            "source": asdict(self._campaign.source),
            "folder": str(self._folder),
            "threads": self._threads,
        }
        self._socket.send_bytes(json.dumps(setup).encode())
        _answer(self._socket, _START_TIMEOUT_S)
        return self._socket

    def _end_of_worker(self, index: int | None = None) -> str:
        """Clean up after a worker that has died, with a run or without, and return its signal or exit code."""
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
        """End the present run without a row; for another thread."""
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
        """End the process, which has no run now."""
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
    """Return the row of a run that did not reach its end."""
    row: Row = {"index": index, "campaign": campaign.id, "outcome": outcome, "error": error}
    row |= {"seed": campaign.seed(index), **parameter_columns(campaign.values(index))}
    return judged(campaign.settings, row)


_PATIENCE_S = 10.0


class LocalWorkers:
    """Workers on this machine, each in a process of its own."""

    def __init__(self, workers: list[WarmWorker]) -> None:
        self._workers = workers
        self._done: SimpleQueue[Row | BaseException | None] = SimpleQueue()
        self._stopping = False
        self._lock = threading.Lock()

    def rows(self, indices: Iterable[int]) -> Iterator[Row]:
        """Do the runs and yield their rows; end before the last run after `stop`. Raises CampaignStopped."""
        waiting = iter(indices)
        threads = [threading.Thread(target=self._work, args=(k, waiting)) for k in range(len(self._workers))]
        for thread in threads:
            thread.start()
        try:
            yield from self._taken(len(threads))
        finally:
            self._end(threads)

    def stop(self) -> None:
        """Begin no further run and abandon the present ones; for a signal handler."""
        self._stopping = True
        for worker in self._workers:
            worker.abandon()

    def _taken(self, working: int) -> Iterator[Row]:
        while working:
            done = self._done.get()
            if isinstance(done, BaseException):
                raise done
            if done is None:
                working -= 1
            else:
                yield done

    def _work(self, number: int, waiting: Iterator[int]) -> None:
        try:
            while (index := self._next(waiting)) is not None:
                self._done.put(self._workers[number].run(index, number))
        except Abandoned:
            pass
        except CampaignStopped as error:
            self._done.put(error)
        except BaseException as error:  # noqa: BLE001 - the thread that takes the rows raises it
            self._done.put(error)
        finally:
            self._done.put(None)

    def _next(self, waiting: Iterator[int]) -> int | None:
        with self._lock:
            return None if self._stopping else next(waiting, None)

    def _end(self, threads: list[threading.Thread]) -> None:
        """Return when no worker is left; those that do not end their run in time are killed."""
        if any(thread.is_alive() for thread in threads):
            self.stop()
        timer = threading.Timer(_PATIENCE_S, self._kill)
        timer.start()
        for thread in threads:
            thread.join()
        for worker in self._workers:
            worker.close()
        timer.cancel()

    def _kill(self) -> None:
        for worker in self._workers:
            worker.kill()


def cores() -> int:
    """Return the number of cores that this process may use."""
    return len(os.sched_getaffinity(0))


class Workers(Protocol):
    """Workers that do runs: processes here, or a cluster."""

    def rows(self, indices: Iterable[int]) -> Iterator[Row]:
        """Do the runs and yield their rows as they come, in any order; raises CampaignStopped."""

    def stop(self) -> None:
        """Begin no further run and abandon the present ones; for a signal handler."""


@dataclass(frozen=True)
class Part:
    """The runs of one job of a job array: every `of`-th, from `number` - 1 on."""

    number: int
    of: int

    def indices(self, runs: int) -> range:
        """Return the indices of the part's runs."""
        return range(self.number - 1, runs, self.of)


def part_of(text: str) -> Part:
    """Return a part written as "3/10", the third of ten; raises ValueError."""
    found = re.fullmatch(r"(\d{1,9})/(\d{1,9})", text)
    if not found or not 1 <= int(found[1]) <= int(found[2]):
        raise ValueError(f"expected I/N with I from 1 to N, such as 3/10, got {text!r}")
    return Part(int(found[1]), int(found[2]))


def remaining(folder: Path, wanted: Iterable[int]) -> list[int]:
    """Return those of the wanted runs that have no row yet."""
    done = done_rows(rows_folder(folder))
    return [index for index in wanted if index not in done]


def run_campaign(
    campaign: Campaign, folder: Path, indices: Iterable[int], workers: Workers, on_row: Callable[[Row], None]
) -> int:
    """Do runs, write each row when it comes, and return the number of rows; raises CampaignStopped.

    Rows that were written always stay.
    """
    count = 0
    rows = workers.rows(indices)
    try:
        for row in rows:
            _write(folder, row, campaign)
            count += 1
            on_row(row)
    finally:
        close = getattr(rows, "close", None)  # a generator stops its workers then
        if close is not None:
            close()
    return count


def _write(folder: Path, row: Row, campaign: Campaign) -> None:
    try:
        write_row(rows_folder(folder), row)
    except OSError as error:
        raise CampaignStopped(
            f"{folder}: {error.strerror or error}: the row of run {row['index']} of {campaign.name} was not written"
        ) from error
