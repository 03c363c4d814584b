"""Runs of a campaign in worker processes on this machine: a thread for each worker waits for its runs."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterable, Iterator
from queue import SimpleQueue

from emulator.campaign.columns import Row
from emulator.campaign.one_run import CampaignStopped
from emulator.campaign.warm_worker import Abandoned, WarmWorker

__all__ = ["LocalWorkers", "cores"]

_PATIENCE_S = 10.0


class LocalWorkers:
    """Does runs with some workers, and gives their rows as they come."""

    def __init__(self, workers: list[WarmWorker]) -> None:
        self._workers = workers
        self._done: SimpleQueue[Row | BaseException | None] = SimpleQueue()
        self._stopping = False
        self._lock = threading.Lock()

    def rows(self, indices: Iterable[int]) -> Iterator[Row]:
        """Do the runs; raises CampaignStopped. It ends before the last run after `stop`."""
        waiting = iter(indices)
        threads = [threading.Thread(target=self._work, args=(k, waiting)) for k in range(len(self._workers))]
        for thread in threads:
            thread.start()
        try:
            yield from self._taken(len(threads))
        finally:
            self._end(threads)

    def stop(self) -> None:
        """Begin no further run and give up those at hand; for a signal handler."""
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
        """Return when no worker is left; those that do not give up their run in time are killed."""
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
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))
