"""Latencies in words."""

from __future__ import annotations

__all__ = ["quantile_text"]


def quantile_text(value_us: float | None) -> str:
    """Return a quantile of latencies, us; "-" where nothing was measured."""
    return "-" if value_us is None else f"{value_us:.0f}"
