"""What a run's camera reads beside events, on its way to the links: frames, samples of an inertial unit.

    ReadingSource --records--> a ReadingRing for each link --> device
                  <--settings-- of the first link whose host has switched this kind on

There is one chip and one picture: where several links' hosts ask for different exposures, the first link decides, and
the others get the frames that it asked for.

The pictures of a scene, one after another, in buffers that are used again.

The events and readings of one step of a run.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from emulator.light import Light, PixelLight, Region, Scene
from firmware_protocol.device.event_device import ReadingKind, Readings
from firmware_protocol.events import Events
from transports.link.process import LinkSetup
from transports.link.rings import ReadingRing

__all__ = ["Pictures", "ReadingSource", "ReadingSources", "StepOutput"]


_CAPACITY = {ReadingKind.FRAMES: 4096, ReadingKind.IMU: 16384}


class ReadingSource(Protocol):
    """Light and time in, readings of one kind out.

    Attributes
    ----------
    kind, record
        Of its readings; the dtype has a field `t`, us of stream time.
    """

    kind: ReadingKind
    record: np.dtype[Any]

    def reset(self, light: Light, t_ns: int) -> None:
        """Start at `t_ns` on `light`, (height, width) float32."""

    def read(self, light: Light, t_ns: int, settings: tuple[int, ...]) -> Readings:
        """Move to `t_ns`, when the light is `light`, and return what was read until then, sorted.

        `settings` are the numbers that the camera's registers ask for; empty: nobody has asked for anything yet.
        """
        ...


class ReadingSources:
    """The sources of a run, and the rings to its links.

    Parameters
    ----------
    setups
        Of the run's links; each with the rings that `new_rings` made for it.
    """

    def __init__(self, sources: Sequence[ReadingSource], setups: Sequence[LinkSetup[Any]]) -> None:
        self._sources = sources
        self._rings = {
            source.kind: [ring for setup in setups for ring in setup.readings if ring.kind == source.kind]
            for source in sources
        }

    @staticmethod
    def new_rings(sources: Sequence[ReadingSource]) -> tuple[ReadingRing, ...]:
        """Return new rings for one link, one for each source."""
        return tuple(ReadingRing(source.kind, source.record, _CAPACITY[source.kind]) for source in sources)

    def reset(self, light: Light, t_ns: int) -> None:
        """Start all at `t_ns` on `light`."""
        for source in self._sources:
            source.reset(light, t_ns)

    def read(self, light: Light, t_ns: int) -> list[tuple[ReadingKind, Readings]]:
        """Move all to `t_ns` and return what each has read."""
        return [(one.kind, one.read(light, t_ns, self._asked(self._rings[one.kind]))) for one in self._sources]

    def _asked(self, rings: Sequence[ReadingRing]) -> tuple[int, ...]:
        """Return the settings of the first link whose first number, `run`, is not zero."""
        return next((told for ring in rings if (told := ring.settings) and told[0]), ())


class Pictures:
    """Draws a scene's light, with its time derivative where the scene has it and the pixels' method uses it.

    Attributes
    ----------
    light
        (height, width) float32, the last picture.
    rate
        (height, width) float32, its derivative, per second; None where none is drawn.
    frames
        Pictures drawn so far.
    pixel_light
        The light of single pixels at any instant, for the refinement of undersampled steps; None where the scene cannot
        give it, or it is not wanted.
    """

    def __init__(self, scene: Scene, *, with_rate: bool, halving: bool = False) -> None:
        width, height = scene.size
        self.scene = scene
        self.light: Light = np.zeros((height, width), np.float32)
        with_rate = with_rate and scene.has_rate
        self.rate: Light | None = np.zeros((height, width), np.float32) if with_rate else None
        self.pixel_light: PixelLight | None = scene.pixel_light if with_rate and halving else None
        self.frames = 0

    @property
    def changed(self) -> Region | None:
        """The part of the last picture that may differ from the one before it; None: anything."""
        return self.scene.changed

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) in pixels."""
        return self.scene.size

    def draw(self, t_ns: int) -> None:
        """Draw the picture of stream time `t_ns`."""
        if self.rate is None:
            self.scene.light(t_ns, self.light)
        else:
            self.scene.light_and_rate(t_ns, self.light, self.rate)
        self.frames += 1


@dataclass(frozen=True)
class StepOutput:
    """Events (n,) EVENT, and readings by their kind, each sorted by time, us of stream time."""

    events: Events
    readings: Sequence[tuple[ReadingKind, Readings]] = ()

    def cut(self, until_us: int) -> tuple[StepOutput, StepOutput]:
        """Return what is up to `until_us`, and the rest."""
        parts = [(kind, records, _up_to(records, until_us)) for kind, records in self.readings]
        n = _up_to(self.events, until_us)
        first = StepOutput(self.events[:n], [(kind, records[:k]) for kind, records, k in parts])
        return first, StepOutput(self.events[n:], [(kind, records[k:]) for kind, records, k in parts])


def _up_to(records: Events | Readings, until_us: int) -> int:
    return int(np.searchsorted(records["t"], np.uint64(until_us), "right"))
