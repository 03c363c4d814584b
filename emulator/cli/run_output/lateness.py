"""Summary lines about lateness: whether the run kept up with the clock, and what to change when it did not."""

from __future__ import annotations

from emulator.rig.loading import Rig
from emulator.run.outcome import RunResult

__all__ = ["lateness_lines"]

_STRETCHED_SHARE = 0.01  # fewer longer steps than this change no result
_WORTH_SAYING_US = 1000.0


def lateness_lines(rig: Rig, result: RunResult) -> list[str]:
    """Return nothing for a run that kept up, else what happened and what to change."""
    late = result.lateness
    if result.too_late:
        return [f"NOT IN REAL TIME: {_broken(rig, result)}. {_remedies(rig)}"]
    if late.worst_gap_us > _WORTH_SAYING_US or late.steps_stretched > _STRETCHED_SHARE * result.steps:
        return [
            f"late: {late.frames_late} of {result.steps} steps, the worst by {late.worst_gap_us:.0f} us; "
            f"{late.steps_stretched} steps made longer to keep up"
        ]
    return []


def _broken(rig: Rig, result: RunResult) -> str:
    """Return which limits the run has broken, and by how much."""
    late, told = result.lateness, []
    if result.step_too_late:
        worst = f"the worst step was {late.worst_gap_us / 1e6:.3g} s late"
        told.append(f"{worst}, and run.max_late_ms is {rig.run.max_late_ms:g}")
    if result.late_too_often:
        often = f"{late.frames_late} of {result.steps} steps ({result.late_share:.1%}) were late"
        told.append(f"{often}, and run.max_late_share is {rig.run.max_late_share:g}")
    return "; ".join(told)


def _remedies(rig: Rig) -> str:
    return (
        f"Take a longer run.step_us (now {rig.run.step_us}) or run.lead_us (now {rig.run.lead_us}), fewer "
        "scene.samples, or a smaller camera; `evstim plan` shows what each costs"
    )
