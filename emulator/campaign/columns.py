"""The columns of a campaign's table: one row for each run.

index, campaign, outcome, error, success, margin, seed, KEY of each parameter
verdict, broken, sim_s, frames, steps, undersampled_share, late_us
events.*, link.NAME.*      fates and digests of the events
program.exit, program.trouble, result.*     how the program ended, and what it wrote as its result
machine.*                  host, wall time, version: the only columns that may differ when a run is repeated
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from emulator.campaign.success import margin, succeeds
from emulator.campaign.tables import Settings
from emulator.rig.loading import Rig
from emulator.run.outcome import RunResult
from emulator.run.verdict import good, judge
from emulator.tables.typed_table import TableError, unknown
from transports.link.report import LinkReport

__all__ = ["Row", "check_columns", "judged", "parameter_columns", "result_columns"]

Row = dict[str, Any]

_OF_PROGRAM = ("program.", "result.")
_ALWAYS = ("index", "outcome", "seed", "verdict", "sim_s", "frames", "steps", "undersampled_share", "late_us")
_EVENTS = ("raised", "lost_in_pixel", "lost_at_readout", "read_out", "rate_hz")
_LINK = ("delivered", "dropped", "dropped_in_device", "latency_p50_us", "latency_p99_us", "latency_max_us")


def parameter_columns(values: Mapping[str, Any]) -> Row:
    """Return the values of the parameters as columns: what is a table or a list, as JSON."""
    return {key: value if isinstance(value, str | int | float) else json.dumps(value) for key, value in values.items()}


def result_columns(rig: Rig, result: RunResult, digest: str) -> Row:
    """Return what a run has done; `digest` is of the events that its sensor read out."""
    judgements = judge(rig.verdict, result)
    ledger = result.ledger
    row: Row = {
        "verdict": good(judgements),
        "broken": "; ".join(f"{one.rule}: {one.told}" for one in judgements if not one.good),
        "sim_s": result.sim_seconds,
        "frames": result.frames,
        "steps": result.steps,
        "undersampled_share": result.undersampled_share,
        "late_us": float(result.lateness.worst_gap_us),
        "events.raised": ledger.raised,
        "events.lost_in_pixel": ledger.lost_in_pixel,
        "events.lost_at_readout": ledger.lost_at_readout,
        "events.read_out": ledger.read_out,
        "events.rate_hz": ledger.read_out / result.sim_seconds if result.sim_seconds else 0.0,
        "events.digest": digest,
    }
    for name, link in result.links.items():
        row |= {f"link.{name}.{column}": value for column, value in _link_columns(link).items()}
    return row


def _link_columns(link: LinkReport) -> Row:
    return {
        "delivered": link.delivered,
        "dropped": link.dropped,
        "dropped_in_device": link.dropped_in_device,
        "digest": f"{link.digest:08x}",
        "latency_p50_us": link.latency.p50,
        "latency_p99_us": link.latency.p99,
        "latency_max_us": link.latency.max,
        "error": link.error or "",
    }


def judged(settings: Settings, row: Row) -> Row:
    """Return a row with its success and its margin."""
    return {**row, "success": succeeds(settings.success, row), "margin": margin(settings.success, row)}


def check_columns(rig: Rig, settings: Settings) -> None:
    """Raise TableError for a column that no row of the campaign has."""
    known = [*_ALWAYS, *(f"events.{name}" for name in _EVENTS), *(law.key for law in settings.parameters)]
    known += ["program.exit", "program.trouble"]
    known += [f"link.{link.name}.{column}" for link in rig.links for column in _LINK]
    for rule in settings.success:
        if rule.column.startswith(_OF_PROGRAM) and settings.program is None:
            raise TableError(f"{rule.told!r} needs a [program]", ("success",))
        _check_column(rule.column, known, ("success",))
    shown = settings.report
    for column in shown.columns:
        _check_column(column, [*known, "success", "margin"], ("report", "columns"))
    _check_column(shown.worst, [*known, "success", "margin"], ("report", "worst"))


def _check_column(column: str, known: list[str], path: tuple[str, ...]) -> None:
    if column not in known and not column.startswith("result."):
        raise TableError(unknown(column, known), path)
