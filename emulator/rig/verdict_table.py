"""The [verdict] table of a rig: what else a run must keep to be good."""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Verdict"]


@dataclass(frozen=True)
class Verdict:
    """What a run must keep, beside a balanced ledger, sound links and whole files; 0 asks for nothing.

    Attributes
    ----------
    max_drop
        Share of the events read out that a link may lose after its camera was started: 0.01 is one in a hundred.
        Negative: any share.
    min_rate_hz, max_rate_hz
        Events a second that the sensor must read out at least, and at most, as a mean over the run.
    max_latency_us
        Most that the 99th percentile of the time from an event to its bytes may be, on any link.
    max_undersampled
        Share of the solved pixel-steps whose light may have changed unseen between two pictures.
    """

    max_drop: float = -1.0
    min_rate_hz: float = 0.0
    max_rate_hz: float = 0.0
    max_latency_us: float = 0.0
    max_undersampled: float = 0.0

    def __post_init__(self) -> None:
        if self.max_drop > 1:
            raise ValueError(f"max_drop is a share, at most 1, got {self.max_drop}")
        for name in ("min_rate_hz", "max_rate_hz", "max_latency_us", "max_undersampled"):
            if not getattr(self, name) >= 0:
                raise ValueError(f"{name} must be 0 (asks for nothing) or more, got {getattr(self, name)}")
        if 0 < self.max_rate_hz < self.min_rate_hz:
            raise ValueError(f"max_rate_hz {self.max_rate_hz} is below min_rate_hz {self.min_rate_hz}")
