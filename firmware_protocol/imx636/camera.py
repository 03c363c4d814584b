"""Parts that all cameras with an IMX636 share: gate, selection, queue, fates, biases.

    array --offer-------> gate -> selection -> Outflow -> words of the link
    input --offer_edges-> gate -------------->

A camera adds its protocol: the registers, which set the gate, the selection and the biases, and its way out.
"""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Mapping
from typing import Generic, TypeVar

from firmware_protocol.device.event_device import EventDevice
from firmware_protocol.device.fates import Fates
from firmware_protocol.device.items import Items, Numbers
from firmware_protocol.events import Edges, Events
from firmware_protocol.imx636.biases import BiasModel
from firmware_protocol.imx636.outflow import Outflow, before
from firmware_protocol.imx636.selection import Selected

__all__ = ["Imx636Camera"]

_Out = TypeVar("_Out", bound=Outflow[Items])


class Imx636Camera(EventDevice, Generic[_Out]):
    """A camera with an IMX636; `_outflow` is that of the present run of the sensor.

    Parameters
    ----------
    size
        (width, height) of the array.
    biases
        Effect of the biases on the sensor.
    """

    def __init__(self, size: tuple[int, int], biases: BiasModel, outflow: _Out) -> None:
        self._size = size
        self._bias_model = biases
        self._outflow = outflow
        self._fates = Fates()
        self._now_us = self._epoch_us = self._silence_end_us = 0
        self._settings_version = 0

    @property
    def now_us(self) -> int:
        """Stream time that the camera has reached."""
        return self._now_us

    @property
    def room_events(self) -> int:
        """Events that fit the buffer now."""
        return self._outflow.room

    @property
    def silent_until_us(self) -> int:
        """End of the silence after the start; 0 while the sensor is stopped."""
        return self._silence_end_us if self._running else 0

    @property
    def epoch_us(self) -> int:
        """Stream time at which device time is zero."""
        return self._epoch_us

    @property
    def sensor_factors(self) -> Mapping[str, float]:
        """Effect on the pixels of the biases that hosts wrote; empty while they are the factory's."""
        return self._bias_model.factors(self._bias_steps)

    @property
    def without_effect(self) -> Mapping[str, str]:
        """Biases that hosts changed without an effect here, each with the reason."""
        return self._bias_model.without_effect(self._bias_steps)

    @property
    def _waiting(self) -> Numbers:
        return self._outflow.waiting

    @property
    def settings_version(self) -> int:
        """Number of writes to its registers."""
        return self._settings_version

    def offer(self, events: Events) -> None:
        """Queue events (n,) EVENT; raises ValueError if they go back in time or lie outside the array."""
        if not len(events):
            return
        self._check(events)
        self._now_us = int(events["t"][-1])
        begun = events[before(events, self._silence_end_us) :] if self._running else events[:0]
        selected = self._select(begun)
        fates = self._fates
        fates.offered += len(events)
        fates.not_running += len(events) - len(begun)
        fates.not_selected += selected.outside
        fates.dropped_rate += selected.beyond_rate
        fates.dropped_fifo += len(selected.events) - self._outflow.put(selected.events)

    def offer_edges(self, edges: Edges) -> None:
        """Apply edges (n,) EDGE to the trigger input."""
        self._fates.edges.offered += len(edges)
        if self._detects and self._now_us >= self._silence_end_us:
            self._put_edges(edges)
        else:
            self._fates.edges.ignored += len(edges)

    def advance(self, now_us: int) -> None:
        """Set stream time to `now_us`; the clock never goes back."""
        self._now_us = max(self._now_us, now_us)

    @property
    @abstractmethod
    def _running(self) -> bool:
        """True if events leave the sensor."""

    @property
    def _detects(self) -> bool:
        """True if the trigger input is on."""
        return self._running

    @property
    @abstractmethod
    def _bias_steps(self) -> Mapping[str, int]:
        """Steps of each bias away from the factory's value, by Prophesee's names."""

    @abstractmethod
    def _select(self, events: Events) -> Selected:
        """Return the part of events, (n,) EVENT, that the registers select."""

    def _put_edges(self, edges: Edges) -> None:
        """Queue edges, (n,) EDGE, that the input has detected."""
        self._fates.edges.dropped_fifo += len(edges) - self._outflow.put_edges(edges)

    def _check(self, events: Events) -> None:
        if int(events["t"][0]) < self._now_us or bool((events["t"][1:] < events["t"][:-1]).any()):
            raise ValueError("events go back in time")
        width, height = self._size
        if int(events["x"].max()) >= width or int(events["y"].max()) >= height:
            raise ValueError(f"events outside the {width} x {height} array")
