"""Latencies in words."""

from __future__ import annotations

from transports.link.latency import LONGEST_US

__all__ = ["quantile_text"]


def quantile_text(value_us: float | None) -> str:
    """Return a quantile of latencies, us; one beyond the longest latency that is measured is marked."""
    if value_us is None:
        return "-"
    return f">= {value_us:.0f}" if value_us >= LONGEST_US else f"{value_us:.0f}"
