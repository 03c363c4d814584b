"""Where every event went. Each event raised has exactly one fate, and the sums must agree at every stop.

    raised  = lost_in_pixel + lost_at_readout + read_out
    read_out = dropped_in_device + delivered + dropped          for every link, which each carry the whole stream

lost_in_pixel      crossings beyond what one pixel may raise in one step
lost_at_readout    the pixel crossed again while its earlier event still waited to be read out
dropped_in_device  the camera was not running, its FIFO was full, or it was flushed at a stop
dropped            lost by the link: its ring was full, or the bytes had left the camera when the host went away
"""

from __future__ import annotations

from dataclasses import dataclass

__all__ = ["Ledger", "LinkLedger"]


@dataclass(frozen=True)
class LinkLedger:
    """The fates of the events that one link was given."""

    name: str
    delivered: int
    dropped: int
    dropped_in_device: int

    @property
    def total(self) -> int:
        """Events accounted for."""
        return self.delivered + self.dropped + self.dropped_in_device


@dataclass(frozen=True)
class Ledger:
    """The fates of all events of a run; `second`: those of a second camera, which has links of its own."""

    raised: int
    lost_in_pixel: int
    lost_at_readout: int
    read_out: int
    links: tuple[LinkLedger, ...] = ()
    second: Ledger | None = None

    @property
    def dropped_in_device(self) -> int:
        """Events dropped inside cameras, summed over the links."""
        return sum(link.dropped_in_device for link in self.links)

    @property
    def imbalance(self) -> int:
        """Events without a fate, or with two: zero in a sound run."""
        sensor = self.raised - self.lost_in_pixel - self.lost_at_readout - self.read_out
        beside = 0 if self.second is None else self.second.imbalance
        return abs(sensor) + sum(abs(self.read_out - link.total) for link in self.links) + beside

    @property
    def balanced(self) -> bool:
        """True when every event has exactly one fate."""
        return self.imbalance == 0

    def as_json(self) -> dict[str, object]:
        """The `events` object of `evstim run --json`."""
        return {
            "raised": self.raised,
            "lost_in_pixel": self.lost_in_pixel,
            "lost_at_readout": self.lost_at_readout,
            "dropped_in_device": self.dropped_in_device,
            "read_out": self.read_out,
            "links": {
                link.name: {
                    "delivered": link.delivered,
                    "dropped": link.dropped,
                    "dropped_in_device": link.dropped_in_device,
                }
                for link in self.links
            },
            **({} if self.second is None else {"second_camera": self.second.as_json()}),
        }
