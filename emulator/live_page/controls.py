"""Contents of the page's controls: the menu of the faults of a link, and the list of changes, each with its undo.

A row of the list is one change from outside, as the run records it. Steps of a slider that is moved are one row. Its
number is the place of its first change in the record, so it never changes, and several pages mean the same row by it.

What can be undone: a parameter is set back while no later change of it exists, and a fault ends while it lasts. Every
other row has the reason why not.
"""

from __future__ import annotations

import dataclasses
import inspect
from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, get_args, get_origin

from emulator.rig.loading import Rig
from emulator.run.changes import Change
from emulator.run.outcome import RunResult, RunStatus, judge
from emulator.tables.typed_table import field_types
from transports.faults.kinds import FAULTS, Fault
from transports.faults.script import FaultRecord
from transports.link.report import LinkReport

if TYPE_CHECKING:
    from emulator.run.session import Session

_NOT_IN_THE_MENU = ("link", "at_s")
_BY_HAND = ("live page", "live page, undo", "evstim", "program")
_NEWEST = 500  # changes of which the list is made
_MOST_ROWS = 60
_MERGE_NS = 1_000_000_000


def fault_menu(faults: Mapping[str, type[Fault]]) -> dict[str, dict[str, Any]]:
    """Return the entry of each fault: its sentence, and its keys with their defaults.

    `disconnects` is True where the host loses the camera, so that the page confirms it.
    """
    return {
        kind: {
            "text": " ".join((inspect.getdoc(fault) or "").partition("\n\n")[0].split()),  # its first sentence
            "disconnects": fault.disconnects,
            "keys": {
                field.name: _key(fault, field)
                for field in dataclasses.fields(fault)
                if field.name not in _NOT_IN_THE_MENU
            },
        }
        for kind, fault in faults.items()
    }


def _key(fault: type[Fault], field: dataclasses.Field[Any]) -> dict[str, Any]:
    """Return the default of a key, with its choices where it has some."""
    annotation = field_types(fault)[field.name]
    choices = list(get_args(annotation)) if get_origin(annotation) is Literal else []
    return {"default": field.default, **({"choices": choices} if choices else {})}


@dataclass(frozen=True)
class _Row:
    """Successive changes that are shown as one: `change` has the value before the first and after the last."""

    number: int
    change: Change
    until_ns: int

    def joins(self, other: Change) -> bool:
        """Return whether a change is a further step of the same movement of a slider."""
        change = self.change
        same = (change.what, change.link, change.by) == (other.what, other.link, other.by) and change.by == "live page"
        return same and other.after is not None and 0 <= other.t_ns - self.until_ns <= _MERGE_NS


class ChangeList:
    """List of the changes of a run from outside, the newest last; its length is bounded."""

    def __init__(self, session: Session) -> None:
        self._session = session
        self._made_of = -1
        self._rows: list[_Row] = []
        self._newest: dict[str, _Row] = {}

    def table(self, links: Mapping[str, LinkReport]) -> dict[str, Any]:
        """Return the newest rows for the page, and the number of changes in all."""
        self._renew()
        rows = [self._shown(row, links) for row in self._rows[-_MOST_ROWS:]]
        return {"changes": rows, "changes_made": len(self._session.changes)}

    def reversible(self, number: int, links: Mapping[str, LinkReport]) -> Change:
        """Return the change of a row that can be undone; raises ValueError with the reason where it cannot."""
        self._renew()
        row = next((row for row in self._rows if row.number == number), None)
        if row is None:
            raise ValueError(f"there is no change {number} in the list")
        if reason := self._reason(row, _record(row.change, links)):
            raise ValueError(f"this cannot be undone: {reason}")
        return row.change

    def _renew(self) -> None:
        changes = self._session.changes
        if len(changes) == self._made_of:
            return
        self._made_of, self._rows = len(changes), []
        for number in range(max(0, len(changes) - _NEWEST), len(changes)):
            change = changes[number]
            if self._rows and (row := self._rows[-1]).joins(change):
                self._rows[-1] = _Row(row.number, dataclasses.replace(row.change, after=change.after), change.t_ns)
            else:
                self._rows.append(_Row(number, change, change.t_ns))
        self._newest = {row.change.what: row for row in self._rows if row.change.after is not None}

    def _shown(self, row: _Row, links: Mapping[str, LinkReport]) -> dict[str, Any]:
        change, record = row.change, _record(row.change, links)
        shown = {
            "number": row.number,
            "t_s": change.t_ns * 1e-9,
            "by": change.by,
            "link": change.link,
            "what": change.what,
            "before": change.before,
            "after": change.after,
            "cannot": self._reason(row, record),
        }
        if record is not None and not _is_end(change):
            shown["fault"] = dataclasses.asdict(record)
        return shown

    def _reason(self, row: _Row, record: FaultRecord | None) -> str:
        """Return the reason why a row cannot be undone; "" where it can."""
        change = row.change
        if change.by not in _BY_HAND:
            return "the host has set it"
        if change.fault:
            return _reason_of_fault(change, record)
        if change.after is None:
            return "the cameras have received it"
        if change.before is None:
            return "the value before it is not known"
        newest = self._newest[change.what]
        if newest is not row:
            how = "set back" if newest.change.by.endswith("undo") else "changed again"
            return f"{how} at {newest.change.t_ns * 1e-9:.3f} s"
        return ""


def _is_end(change: Change) -> bool:
    return change.what.startswith("end of ")


def _record(change: Change, links: Mapping[str, LinkReport]) -> FaultRecord | None:
    """Return the link's record of a change that is a fault; None where a restarted link has lost it."""
    report = links.get(change.link)
    if not change.fault or report is None:
        return None
    of_number = (record for record in report.faults if record.number == change.fault)
    return next((record for record in of_number if record.began_us <= (change.taken_us or 0)), None)


def _reason_of_fault(change: Change, record: FaultRecord | None) -> str:
    if _is_end(change):
        return "inject the fault again"
    if record is None:
        return "the link has no record of this fault yet, or was started again"
    if FAULTS[record.kind].disconnects:
        return "the host has lost the camera, and must open it again"
    if record.ended_us is not None:
        return f"over since {record.ended_us / 1e6:.3f} s"
    return ""


def totals(run: RunStatus | RunResult) -> dict[str, Any]:
    """Return the values by which two runs are compared, of a run that goes on or has ended."""
    ledger = run if isinstance(run, RunStatus) else run.ledger
    return {
        "t_s": run.sim_seconds,
        "raised": ledger.raised,
        "read_out": ledger.read_out,
        "frames_late": run.lateness.frames_late,
        "frames": run.frames,
        "links": {
            name: {
                "delivered": link.delivered,
                "dropped": link.dropped + link.dropped_in_device,
                "p50": link.latency.p50,
                "p99": link.latency.p99,
            }
            for name, link in run.links.items()
        },
    }


_MOST_SEED = 2**63 - 1


class Repeats:
    """Request of a viewer to start the run again with another seed, and the totals of the run before.

    Attributes
    ----------
    obstacle : reason why the run cannot be started again; "" where it can.
    before : seed, totals, verdict and number of changes of the run before; None in the first one.
    place : (port, token) of the page, which the next run keeps; None before the first page.
    seed : requested seed; None where no viewer has requested a new run.
    count : number of runs before this one.
    """

    def __init__(self, obstacle: str = "") -> None:
        self.obstacle = obstacle
        self.before: dict[str, Any] | None = None
        self.place: tuple[int, str] | None = None
        self.seed: int | None = None
        self.count = 0

    def request(self, seed: int) -> None:
        """Request a new run with a seed; raises ValueError where it cannot start, or another one is requested."""
        if self.obstacle:
            raise ValueError(f"this run cannot be started again: {self.obstacle}")
        if self.seed is not None:
            raise ValueError(f"a run with seed {self.seed} is starting already")
        if not 0 <= seed <= _MOST_SEED:
            raise ValueError(f"seed must be 0 to {_MOST_SEED}, got {seed}")
        self.seed = seed

    def cancel(self) -> None:
        """Cancel the request, and refuse others: the run ends for good."""
        self.seed, self.obstacle = None, "it ends"

    def take(self, rig: Rig, result: RunResult) -> int | None:
        """Return the requested seed, once, and store the totals of the run that has ended."""
        seed, self.seed = self.seed, None
        if seed is not None:
            self.count += 1
            rules = judge(rig.verdict, result)
            broken = [rule.rule for rule in rules if not rule.good]
            self.before = {
                **totals(result),
                "seed": rig.run.seed,
                "verdict": f"not good: {', '.join(broken)}" if broken else f"good: {len(rules)} rules kept",
                "changes": len(result.changes) + result.changes_beyond,
            }
        return seed
