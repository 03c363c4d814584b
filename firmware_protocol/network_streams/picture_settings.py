"""What streams of pictures show: the channels of event images, and the colours of the display."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["Channel", "Colour", "PictureSettings"]

Channel = Literal["on", "off", "count", "first_us", "last_us", "level", "filtered"]
Colour = tuple[int, int, int]


@dataclass(frozen=True)
class PictureSettings:
    """What pictures of events show, of the formats "event_image" and "display".

    Attributes
    ----------
    channels
        Of an event image, in this order; see docs/streams.md.
    filter_ms
        Time constant of the low pass behind the channel "filtered" and behind the display's light.
    on_colour, off_colour
        Red, green, blue, 0 to 255, of pixels of the display with more ON, or more OFF events.
    both_colour
        Of pixels with as many of both.
    background
        Of pixels without an event, where no light is shown.
    light_share
        How much of the filtered level is shown as grey, 0 (none) to 1.
    light_below_events
        Whether it is also added to pixels that have events.
    contrast
        Log light that one event stands for, where the level is shown as grey.
    """

    channels: tuple[Channel, ...] = ("on", "off", "first_us", "last_us", "level")
    filter_ms: float = 100.0
    on_colour: Colour = (0, 255, 0)
    off_colour: Colour = (255, 0, 0)
    both_colour: Colour = (255, 255, 0)
    background: Colour = (32, 32, 32)
    light_share: float = 0.0
    light_below_events: bool = False
    contrast: float = 0.25

    def __post_init__(self) -> None:
        if not self.channels or len(set(self.channels)) != len(self.channels):
            raise ValueError(f"channels must be one or more, each once, got {list(self.channels)}")
        bounds = {"filter_ms": (0.1, 60_000), "light_share": (0, 1), "contrast": (0.001, 10)}
        for name, (low, high) in bounds.items():
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"{name} must be {low:g} to {high:g}, got {getattr(self, name)}")
        for name in ("on_colour", "off_colour", "both_colour", "background"):
            if not all(0 <= value <= 255 for value in getattr(self, name)):
                raise ValueError(f"{name} must be red, green, blue from 0 to 255, got {list(getattr(self, name))}")

    @property
    def filter_us(self) -> float:
        """Time constant of the low pass, us."""
        return self.filter_ms * 1000

    @property
    def shows_light(self) -> bool:
        """Whether the display shows grey behind the events."""
        return self.light_share > 0
