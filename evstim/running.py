"""A rig that runs beside a Python program, which reads its events meanwhile.

    body of the `with` block:  for events in run  <--- bounded queue <--- thread: scene, sensor, links (Session)
                                                            or       <--- thread: deliveries of one link

The session has a thread of its own, so that a slow reader does not disturb the links. With pace "free" it waits for the
reader and no event is lost; in real time and in lockstep it does not wait, and `run.unread` counts the events that
found the queue full.
"""

from __future__ import annotations

import logging
import threading
from collections import deque
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager, contextmanager, nullcontext
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Generic, Literal, Protocol, Self, TypedDict, TypeVar, Unpack, overload

from emulator.rig.kinds import assigned_fault, convert_fault
from emulator.rig.loading import Rig, load_rig, with_options
from emulator.run import fill_standard_descriptors
from emulator.run.assembly import build_scene, build_session, link_setups, schedule
from emulator.run.kernels import parts_of, prepare, uncompiled
from emulator.run.outcome import RunResult, RunStatus
from emulator.run.session import Session
from emulator.run.truth.source import TruthSelection, check_truth
from evstim.deliveries import Delivery, forwarding
from firmware_protocol.events import Events
from transports.faults.kinds import Fault
from transports.link.loop import InjectFault
from transports.link.pacing import MonotonicClock
from transports.link.process import LinkSetup

if TYPE_CHECKING:
    from emulator.run.truth.source import TruthFile

log = logging.getLogger(__name__)

_MOST_QUEUED_BYTES = 52_000_000  # 4 million events


class _Sized(Protocol):
    @property
    def nbytes(self) -> int: ...


Batch = TypeVar("Batch", bound=_Sized)
Pace = Literal["realtime", "free"]


class _RunOptions(TypedDict, total=False):
    """Options of `run` that do not change the type of what it yields."""

    seconds: float | None
    seed: int | None
    pace: Pace | None
    record: str | Path | None
    truth: str | Path | None
    truth_every: int | None


@overload
def run(rig: str | Path | Rig, *, link: None = None, **options: Unpack[_RunOptions]) -> LiveRun[Events]: ...


@overload
def run(rig: str | Path | Rig, *, link: str, **options: Unpack[_RunOptions]) -> LiveRun[Delivery]: ...


def run(
    rig: str | Path | Rig,
    *,
    link: str | None = None,
    seconds: float | None = None,
    seed: int | None = None,
    pace: Pace | None = None,
    record: str | Path | None = None,
    truth: str | Path | None = None,
    truth_every: int | None = None,
) -> LiveRun[Any]:
    """Return a run of a rig: a context manager that starts it, and an iterator of its events or deliveries.

    Parameters
    ----------
    rig : path of a rig file, name of a shipped rig, or a Rig.
    link : name of a link of the rig: iterating yields what this link delivers, as `Delivery` objects with events,
        triggers, IMU samples and frames. By default it yields the events of the sensor, (n,) EVENT.
    seconds : stream time to run for; 0 means until the `with` block ends. By default the rig's own.
    seed : seed of everything random. By default the rig's own.
    pace : "realtime": every event leaves at its own time; "free": as fast as the machine can, losing nothing.
    record : file for what the links deliver, in the format of its suffix; see `read_events` and docs/recordings.md.
    truth : .h5 file for the truth of the run: light, depth, flow, labels, poses, origins; see docs/recordings.md.
    truth_every : light, depth, flow and labels of every n-th light frame go into it, by default of 25 a second.

    Raises
    ------
    RigError
        The rig cannot be used.
    ValueError
        An option is out of its range, the rig has no link of that name or nothing to record, or no truth; or `link` is
        given for a rig that starts its links again (`run.restart_links`).
    ImportError
        `truth` needs h5py.
    """
    fill_standard_descriptors()
    loaded = rig if isinstance(rig, Rig) else load_rig(str(rig))
    if record is not None and not loaded.links:
        raise ValueError("record: this rig has no link, so no event is delivered")
    loaded = with_options(loaded, seconds, seed, pace)
    if truth is not None:
        check_truth(loaded, TruthSelection(truth_every), Path(truth))
    _check_link(loaded, link)
    recorded, true = (None if path is None else Path(path) for path in (record, truth))
    return LiveRun(loaded, recorded, true, truth_every, link)


def _check_link(rig: Rig, link: str | None) -> None:
    names = [rig_link.name for rig_link in rig.links]
    if link is not None and link not in names:
        raise ValueError(f"link: this rig has no link {link!r}; it has {', '.join(names) or 'none'}")
    if link is not None and rig.run.restart_links:
        raise ValueError(
            "link: the deliveries of a link that is started again cannot be read; set restart_links to False"
        )


class LiveRun(Generic[Batch]):
    """A run that goes on while its `with` block does. Made by `run`.

    Iterating over it gives (n,) EVENT arrays as the sensor reads them out, n > 0, or the `Delivery` objects of one
    link, and ends with the run. Leaving the block, also by `break` or an exception, stops the run after its present
    step.

    Attributes
    ----------
    rig : the rig of the run.
    unread : events that were not queued for the iterator, because the reader was too slow; 0 with pace "free".
    truth_trouble : why the truth file is not whole; "" where it is, or where there is none. Set at the end.
    """

    def __init__(
        self,
        rig: Rig,
        record: Path | None = None,
        truth: Path | None = None,
        truth_every: int | None = None,
        link: str | None = None,
    ) -> None:
        self.rig = rig
        self._link = link
        self.unread = 0
        self.truth_trouble = ""
        self._record = record
        self._truth = truth
        self._truth_every = truth_every
        self._changed = threading.Condition()
        self._batches: deque[Any] = deque()
        self._queued_bytes = 0
        self._thread: threading.Thread | None = None
        self._session: Session | None = None
        self._status: RunStatus | None = None
        self._result: RunResult | None = None
        self._error: BaseException | None = None
        self._faults: deque[Fault] = deque()
        self._stopping = self._ended = self._discarding = False

    @property
    def result(self) -> RunResult:
        """Counts, ledger and link reports of the run, which has ended; raises RuntimeError before the end."""
        if self._result is None:
            raise RuntimeError("the run has no result before the end of its `with` block (or of `wait`)")
        return self._result

    @property
    def status(self) -> RunStatus | None:
        """Counts and link states now, renewed ten times a second; None while the run starts."""
        return self._status

    def wait_until_ready(self, timeout_s: float = 300.0) -> Mapping[str, str | None]:
        """Wait until every link is open and stream time runs; return the address of each link by its name.

        Raises TimeoutError after `timeout_s`, the run's own error where it could not start, and RuntimeError where it
        ended first.
        """
        with self._changed:
            come = self._changed.wait_for(lambda: self._status is not None or self._ended, timeout_s)
        if not come:
            raise TimeoutError(f"the run of {self.rig.name!r} is not ready after {timeout_s:g} s")
        if self._status is None:
            self._join()
            raise RuntimeError(f"the run of {self.rig.name!r} ended before it was ready")
        return {name: link.address for name, link in self._status.links.items()}

    def inject(self, fault: Fault | Mapping[str, Any]) -> None:
        """Begin a fault within a tenth of a second; `at_s` has no meaning here.

        Parameters
        ----------
        fault : such as `evstim.BitFlips(rate=1e-3)`, or a table with the keys of [[faults]] of a rig.

        Raises
        ------
        TableError
            No link of this rig can have the fault, or several can and its `link` is not given.
        """
        if isinstance(fault, Fault):
            self._faults.append(assigned_fault(fault, self.rig.links))
        else:
            self._faults.append(convert_fault(dict(fault), self.rig.links, ()))

    def stop(self) -> None:
        """End the run after its present step."""
        with self._changed:
            self._stopping = True
            if self._session is not None:
                self._session.stop()
            self._changed.notify_all()

    def wait(self) -> RunResult:
        """Let the run go to its end, without reading its further events, and return the result."""
        with self._changed:
            self._discarding = True
            self._batches.clear()
            self._queued_bytes = 0
            self._changed.notify_all()
        self._join()
        return self.result

    def __enter__(self) -> Self:
        if self._thread is not None:
            raise RuntimeError("this run has been started before: call evstim.run again")
        self._thread = threading.Thread(target=self._work, name=f"evstim {self.rig.name}")
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.stop()
        try:
            self._join()
        except Exception as own:
            if error is None:
                raise
            if own is not error:
                error.add_note(f"the run failed as well: {own}")

    def __iter__(self) -> Iterator[Batch]:
        if self._thread is None:
            raise RuntimeError("the run has not been started: use `with evstim.run(...) as run:`")
        while (batch := self._next()) is not None:
            yield batch
        self._join()

    def _next(self) -> Batch | None:
        with self._changed:
            self._changed.wait_for(lambda: self._batches or self._ended)
            if not self._batches:
                return None
            batch: Batch = self._batches.popleft()
            self._queued_bytes -= batch.nbytes
            self._changed.notify_all()
            return batch

    def _join(self) -> None:
        """Wait for the thread, and raise its error here."""
        if self._thread is not None:
            self._thread.join()
        if self._error is not None:
            raise self._error

    def _work(self) -> None:
        """Run the session; in a thread, where the scene may hold a GL context."""
        try:
            self._run()
        except BaseException as error:  # noqa: BLE001 - `_join` raises it again in the reader's thread
            self._error = error
        with self._changed:
            self._ended = True
            self._changed.notify_all()

    def _run(self) -> None:
        if missing := uncompiled(parts_of(self.rig)):
            log.warning("compiling, once on this machine: %s", ", ".join(part.name for part in missing))
            prepare(missing)
        setups = link_setups(self.rig, self._record)
        with build_scene(self.rig) as scene, self._opened_truth() as truth, self._forwarding(setups) as links:
            session = build_session(self.rig, scene, links, MonotonicClock(), truth)
            with self._changed:
                self._session = session
                if self._stopping:
                    session.stop()
            self._result = session.run(schedule(self.rig), self._renew, self._take)

    @contextmanager
    def _opened_truth(self) -> Iterator[TruthFile | None]:
        if self._truth is None:
            yield None
            return
        from emulator.run.truth.source import TruthFile

        with TruthFile(self.rig, self._truth, TruthSelection(self._truth_every)) as truth:
            yield truth
        self.truth_trouble = truth.trouble

    def _forwarding(self, setups: list[LinkSetup[Any]]) -> AbstractContextManager[list[LinkSetup[Any]]]:
        if self._link is None:
            return nullcontext(setups)
        return forwarding(setups, self._link, self._receive, self._miss)

    def _renew(self, status: RunStatus) -> None:
        """Take the session's status, in its thread, and begin the faults that were injected since the last one."""
        with self._changed:
            self._status = status
            self._changed.notify_all()
        while self._session is not None and self._faults:
            fault = self._faults.popleft()
            self._session.order(fault.link, InjectFault(fault, "program"))

    def _take(self, events: Events) -> None:
        """Queue the events of a step, or wait until there is room for more deliveries; in the session's thread."""
        with self._changed:
            if self.rig.run.pace == "free":
                own_bytes = 0 if self._link else events.nbytes
                self._changed.wait_for(lambda: self._has_room(own_bytes) or self._stopping or self._discarding)
            if self._link is None and len(events):
                self._queue(events, len(events), is_bounded=True)

    def _receive(self, delivery: Delivery) -> None:
        """Queue a delivery of the link, in a thread that must not wait.

        With pace "free" the queue has no bound here: `_take` holds the session back, so that only the events that are
        in the link at this moment can follow.
        """
        with self._changed:
            self._queue(delivery, len(delivery.events), is_bounded=self.rig.run.pace != "free")

    def _miss(self, events: int) -> None:
        self.unread += events

    def _queue(self, batch: Any, events: int, *, is_bounded: bool) -> None:
        has_room = self._has_room(batch.nbytes) or not is_bounded
        if self._discarding or (self._stopping and not has_room):
            return
        if not has_room:
            self.unread += events
            return
        self._batches.append(batch)
        self._queued_bytes += batch.nbytes
        self._changed.notify_all()

    def _has_room(self, more_bytes: int) -> bool:
        return not self._queued_bytes or self._queued_bytes + more_bytes <= _MOST_QUEUED_BYTES
