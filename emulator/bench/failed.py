"""When a measurement means nothing."""

from __future__ import annotations

__all__ = ["BenchFailed"]


class BenchFailed(Exception):
    """The thing measured did not do its job, so its speed means nothing."""
