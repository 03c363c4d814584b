"""Runs of a campaign on a dask.distributed cluster: each of its workers has worker processes of evstim beside it.

A task may not start processes of its own nor handle signals inside a dask worker, so a task sends its run to a separate
process, which ends with the dask worker.
"""

from __future__ import annotations

import atexit
import importlib
import threading
from concurrent.futures import CancelledError
from contextlib import suppress
from dataclasses import asdict
from importlib.metadata import version
from pathlib import Path
from typing import Any

from emulator.campaign.campaign import Campaign, Row
from emulator.campaign.loading import Source
from emulator.campaign.one_run import CampaignStopped
from emulator.campaign.workers import WarmWorker, Workers, lost_row
from transports.needs import install_command

_CONNECT_S = 15
_FIRST_WORKER_S = 120
_AHEAD = 2  # tasks for each thread of the cluster: no worker waits for its next run


class DaskWorkers(Workers):
    """Workers on the cluster of a scheduler, such as tcp://10.0.0.1:8786; CampaignStopped if none answers there."""

    def __init__(self, campaign: Campaign, folder: Path, address: str) -> None:
        super().__init__()
        self._campaign = campaign
        self._folder = folder
        self._address = address
        self._futures: dict[str, Any] = {}
        self._client = _connected(address)

    def _size(self) -> int:
        try:
            self._client.wait_for_workers(1, timeout=_FIRST_WORKER_S)
        except TimeoutError as error:
            message = f"--scheduler: {self._address} has had no worker for {_FIRST_WORKER_S} s"
            raise CampaignStopped(message) from error
        return _AHEAD * (sum(self._client.nthreads().values()) or 1)

    def _submit(self, index: int, number: int) -> Any:
        arguments = (asdict(self._campaign.source), str(self._folder), index, number, version("evstim"))
        key = f"evstim-{self._campaign.id}-{index}"
        self._futures[key] = self._client.submit(_task, *arguments, key=key, pure=False, retries=0)
        return self._futures[key]

    def _row(self, future: Any, index: int) -> Row:
        del self._futures[future.key]
        if future.status == "finished":
            try:
                row: Row = future.result()
            except (OSError, CancelledError) as lost:
                raise self._gone() from lost
            return row
        error = future.exception() if future.status == "error" else None
        if error is None:
            raise self._gone()
        if type(error).__name__ == "KilledWorker":
            return lost_row(self._campaign, index, "crashed", f"the workers died that had this run: {error}")
        if isinstance(error, CampaignStopped):
            raise error
        raise CampaignStopped(f"--scheduler: a worker cannot do run {index}: {type(error).__name__}: {error}")

    def _gone(self) -> CampaignStopped:
        return CampaignStopped(f"--scheduler: {self._address} is gone, or has cancelled the runs")

    def _close(self) -> None:
        """Disconnect from the cluster; a process there ends with its run."""
        with suppress(Exception):
            self._client.cancel(list(self._futures.values()))
            self._client.run(_end_processes)
        with suppress(Exception):
            self._client.close(timeout=5)


def _connected(address: str) -> Any:
    try:
        distributed = importlib.import_module("distributed")
    except ImportError as error:
        raise CampaignStopped(f"--scheduler needs dask.distributed:  {install_command('campaign')}") from error
    try:
        return distributed.Client(address, timeout=_CONNECT_S, set_as_default=False)
    except (OSError, TimeoutError, ValueError) as error:
        raise CampaignStopped(f"--scheduler: no scheduler answers at {address}: {str(error)[:200]}") from error


_idle: dict[str, list[WarmWorker]] = {}
_lock = threading.Lock()


def _task(source: dict[str, Any], folder: str, index: int, number: int, client_version: str) -> Row:
    """Do a run, in a dask worker."""
    worker_version = version("evstim")
    if worker_version != client_version:
        raise CampaignStopped(
            f"a worker has evstim {worker_version}, the campaign is of {client_version}: install the same everywhere"
        )
    campaign = Campaign(Source(**source))
    with _lock:
        idle = _idle.setdefault(campaign.id, [])
        worker = idle.pop() if idle else WarmWorker(campaign, Path(folder), threads=1)
    row = worker.run(index, number)
    with _lock:
        _idle.setdefault(campaign.id, []).append(worker)
    return row


def _end_processes() -> None:
    """End the processes that have no run, in a dask worker."""
    with _lock:
        workers = [worker for idle in _idle.values() for worker in idle]
        _idle.clear()
    for worker in workers:
        worker.close()


atexit.register(_end_processes)
