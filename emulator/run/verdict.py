"""Whether a run was good, rule by rule: those that hold for every run, and those of the rig's [verdict] table."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from emulator.rig.verdict_table import Verdict
from emulator.run.outcome import RunResult
from transports.link.report import LinkReport

__all__ = ["Judgement", "good", "judge"]


@dataclass(frozen=True)
class Judgement:
    """One rule and what became of it.

    Attributes
    ----------
    rule : its name, the same in every report.
    good : whether the run kept it.
    told : limit and finding, for people.
    """

    rule: str
    good: bool
    told: str


def judge(rules: Verdict, result: RunResult) -> tuple[Judgement, ...]:
    """Return every rule that was applied to a run that has ended."""
    return (*_always(result), *_own(rules, result))


def good(judgements: tuple[Judgement, ...]) -> bool:
    """Return whether all rules were kept."""
    return all(one.good for one in judgements)


def _always(result: RunResult) -> Iterator[Judgement]:
    imbalance = result.ledger.imbalance
    yield Judgement("ledger", not imbalance, "balanced" if not imbalance else f"off by {imbalance} events")
    for name, link in result.links.items():
        trouble = [link.error] if link.error is not None else []
        trouble += [] if link.edges_balanced else ["edges without a fate"]
        trouble += [] if link.readings_balanced else ["frames or samples without a fate"]
        trouble += link.file_troubles
        yield Judgement(f"link {name}", not trouble, "; ".join(trouble) or "sound")
    if result.max_late_us > 0:
        worst_ms = result.lateness.worst_gap_us * 1e-3
        told = f"worst step {worst_ms:.3g} ms late, run.max_late_ms is {result.max_late_us * 1e-3:g}"
        yield Judgement("in real time", not result.step_too_late, told)
        late = f"{result.lateness.frames_late} of {result.steps} steps late ({result.late_share:.3g})"
        told = f"{late}, run.max_late_share is {result.max_late_share:g}"
        yield Judgement("steps in time", not result.late_too_often, told)


def _own(rules: Verdict, result: RunResult) -> Iterator[Judgement]:
    if rules.max_drop >= 0:
        yield from (_drop(rules.max_drop, result, name, link) for name, link in result.links.items())
    rate_hz = result.ledger.read_out / result.sim_seconds if result.sim_seconds else 0.0
    if rules.min_rate_hz:
        told = f"{rate_hz:.4g} events/s, at least {rules.min_rate_hz:g}"
        yield Judgement("verdict.min_rate_hz", rate_hz >= rules.min_rate_hz, told)
    if rules.max_rate_hz:
        told = f"{rate_hz:.4g} events/s, at most {rules.max_rate_hz:g}"
        yield Judgement("verdict.max_rate_hz", rate_hz <= rules.max_rate_hz, told)
    if rules.max_latency_us:
        yield from (_latency(rules.max_latency_us, name, link) for name, link in result.links.items())
    if rules.max_undersampled and result.undersampled_share is not None:
        share = result.undersampled_share
        told = f"{share:.3g} of the solved pixel-steps, at most {rules.max_undersampled:g}"
        yield Judgement("verdict.max_undersampled", share <= rules.max_undersampled, told)


def _drop(most: float, result: RunResult, name: str, link: LinkReport) -> Judgement:
    """Judge what a link lost; what came while no host was streaming, or was not selected, was not to be sent."""
    in_camera = 0 if link.camera is None else link.camera.dropped_for_room
    lost = link.dropped + in_camera
    wanted = lost + link.delivered
    share = lost / wanted if wanted else 0.0
    told = f"{lost} of {wanted} events lost ({share:.3g}), at most {most:g}"
    return Judgement(f"verdict.max_drop {name}", share <= most, told)


def _latency(most_us: float, name: str, link: LinkReport) -> Judgement:
    p99_us = link.latency.p99
    if p99_us is None:
        return Judgement(f"verdict.max_latency_us {name}", True, "nothing was sent")
    told = f"99th percentile {p99_us:.0f} us, at most {most_us:g}"
    return Judgement(f"verdict.max_latency_us {name}", p99_us <= most_us, told)
