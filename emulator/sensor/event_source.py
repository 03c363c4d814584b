"""The source of a session's events: a simulated sensor, or a recording in its place."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, runtime_checkable

from emulator.light import LightFrame
from emulator.sensor.aps.parameters import KickParameters
from emulator.sensor.aps.row_kicks import LineReads
from emulator.sensor.presets import SensorParameters
from firmware_protocol.events import Events

__all__ = ["AdjustableSource", "EventSource"]


class EventSource(Protocol):
    """Light in, events out. Every event raised is lost in the pixel, lost at the read-out, or read out."""

    parameters: SensorParameters

    @property
    def raised(self) -> int:
        """Events raised since `reset`."""
        ...

    @property
    def lost_in_pixel(self) -> int:
        """Of these, lost in their pixel."""
        ...

    @property
    def lost_at_readout(self) -> int:
        """Of these, lost at the arbiter."""
        ...

    @property
    def read_out(self) -> int:
        """Of these, returned."""
        ...

    @property
    def undersampled_share(self) -> float | None:
        """Share of the solved pixel-steps whose light changed too quickly between two frames; None where unknown."""
        ...

    def with_kicks(self, kicks: KickParameters) -> Callable[[LineReads], None] | None:
        """Return the receiver of reads of active pixels, which disturb the events from then on; None where they cannot.

        Each call of the receiver gives the reads that begin in the next step.
        """

    def warm_up(self) -> None:
        """Do the slow work of a first step, such as compiling kernels; later results do not change."""

    def reset(self, frame: LightFrame) -> None:
        """Start at rest on the light of `frame`, at its time."""

    def expose(self, frame: LightFrame) -> Events:
        """Move to the time of `frame` and return the events that leave before it; see `Sensor.expose`."""
        ...

    def finish(self) -> Events:
        """Return the events that have not left yet."""
        ...


@runtime_checkable
class AdjustableSource(Protocol):
    """A source with parameters that can change between two steps."""

    @property
    def adjustable(self) -> dict[str, float]:
        """Fields of SensorParameters that can change, with their present values."""
        ...

    def adjust(self, name: str, value: float) -> None:
        """Set one of them from now on; raises ValueError."""
