"""The share of undersampled pixel-steps of a run in words, the same for the terminal and the report."""

from __future__ import annotations

__all__ = ["undersampled_advice", "undersampled_text"]

_MANY = 0.1  # above it, shorter steps for all pixels are cheaper than refining single ones


def undersampled_text(share: float | None) -> str:
    """Return the share of the solved pixel-steps in which the light changed unseen between two light frames."""
    return "not measured" if share is None else f"{share:.3g} of the solved pixel-steps"


def undersampled_advice(share: float | None) -> str:
    """Return what to change where the share is large; "" where it is not."""
    if share is None or share <= _MANY:
        return ""
    return (
        f"pictures too far apart: in {share:.0%} of the solved pixel-steps the light changed unseen between them; "
        "shorten run.step_us, or give run.tolerance_us"
    )
