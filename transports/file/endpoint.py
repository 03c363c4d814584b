"""The far end of a link that is a file: a process that writes it, beside the one that feeds it."""

from __future__ import annotations

import asyncio
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.plain_device import PlainDevice, Taken, own_time
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.recording.format import Format
from transports.recording.live import LiveRecorder
from transports.recording.part import Facts, Part

__all__ = ["FileEndpoint", "FileFactory"]

_MOST_EVENTS = 1 << 16  # handed over at once


@dataclass(frozen=True)
class FileFactory(EndpointFactory[PlainDevice]):
    """Opens the file in the link's process."""

    path: Path
    form: Format
    facts: Facts

    def build(self, device: PlainDevice, deliveries: Deliveries) -> FileEndpoint:
        """Return the endpoint, which opens the file when it is started."""
        return FileEndpoint(self, device, deliveries)


class FileEndpoint(Endpoint):
    """Hands over what the device has, as fast as the writer takes it."""

    def __init__(self, order: FileFactory, device: PlainDevice, deliveries: Deliveries) -> None:
        self._order = order
        self._device = device
        self._deliveries = deliveries
        self._recorder: LiveRecorder | None = None
        self._epoch_us: int | None = None
        self._handed = 0

    async def start(self) -> None:
        """Start the writer; raises OSError where the file cannot be opened."""
        order = self._order
        self._recorder = await asyncio.to_thread(LiveRecorder, order.path, order.form, order.facts, "file")

    def pump(self) -> None:
        """Hand over what waits."""
        recorder = self._recorder
        if recorder is None:
            return
        if recorder.broken:
            self._device.drop_waiting()
            return
        while (room := min(recorder.room, _MOST_EVENTS)) and (taken := self._device.take(room)) is not None:
            self._hand_over(recorder, taken)

    def _hand_over(self, recorder: LiveRecorder, taken: Taken) -> None:
        restarted = taken.epoch_us != self._epoch_us
        self._epoch_us = taken.epoch_us
        recorder.append(
            Part(own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us)),
            restarted=restarted,
            unix_us=self._deliveries.unix_us(taken.epoch_us),
        )
        self._deliveries.add(taken.events, taken.epoch_us, taken.edges)
        self._handed += len(taken.events)

    async def close(self) -> None:
        """Let the writer finish; what it could not write is counted as lost on the link."""
        if self._recorder is None:
            return
        await asyncio.to_thread(self._recorder.close)
        self._device.drop_waiting()
        written = self._recorder.report.get("events")
        self._device.lost(self._handed - (written if isinstance(written, int) else 0))

    @property
    def state(self) -> str:
        """The file and how much went there."""
        if self._recorder is not None and self._recorder.broken:
            return "stopped"
        return f"{self._handed} events to {self._order.path.name}"

    @property
    def address(self) -> str | None:
        """The file's path."""
        return str(self._order.path)

    @property
    def trouble(self) -> str:
        """Why the file is not whole."""
        return "" if self._recorder is None else self._recorder.trouble

    @property
    def counts(self) -> Mapping[str, int]:
        """How many files there are, where the camera's clock started anew."""
        paths = [] if self._recorder is None else self._recorder.report.get("paths", [])
        return {"files": len(paths)} if len(paths) > 1 else {}
