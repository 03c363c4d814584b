"""The endpoint of a link that is a file: it hands over what the device has to a process that writes the file."""

from __future__ import annotations

import asyncio
import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from firmware_protocol.plain_device import PlainDevice, Taken
from firmware_protocol.readings import ReadingKind
from transports.link.delivered_parts import Delivered, DeliveredParts
from transports.link.deliveries import Deliveries
from transports.link.endpoint import Endpoint, EndpointFactory
from transports.recording.format import Format, with_addition
from transports.recording.live import LiveRecorder
from transports.recording.part import Facts, counts_of
from transports.recording.summary import RecordingSummary

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

    def restarted(self, number: int) -> FileFactory:
        """Return the same with a file of its own: what the killed process sent stays in the first."""
        return dataclasses.replace(self, path=with_addition(self.path, f"restart{number}"))


class FileEndpoint(Endpoint):
    """Hands over what the device has, as fast as the writer takes it."""

    def __init__(self, order: FileFactory, device: PlainDevice, deliveries: Deliveries) -> None:
        self._order = order
        self._device = device
        self._deliveries = deliveries
        self._parts = DeliveredParts(order.facts.imu_unit)
        self._recorder: LiveRecorder | None = None
        self._epoch_us: int | None = None
        self._handed: Counter[str] = Counter()

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
        if not self._device.waiting and self._epoch_us == self._device.epoch_us:
            recorder.reach(self._device.now_us - self._device.epoch_us)

    def _hand_over(self, recorder: LiveRecorder, taken: Taken) -> None:
        restarted = taken.epoch_us != self._epoch_us
        self._epoch_us = taken.epoch_us
        part = self._parts.part(Delivered(taken.events, taken.edges, taken.readings), taken.epoch_us)
        if restarted or counts_of(part):
            recorder.append(part, restarted=restarted, unix_us=self._deliveries.unix_us(taken.epoch_us))
        self._deliveries.add(taken.events, taken.epoch_us, taken.edges, taken.readings)
        self._handed.update(counts_of(part))

    async def close(self) -> None:
        """Let the writer finish; what it could not write is counted as lost on the link."""
        if self._recorder is None:
            return
        await asyncio.to_thread(self._recorder.close)
        self._device.drop_waiting()
        summary = self._recorder.summary
        lost = self._handed - Counter(summary.written) - Counter(summary.left_out)
        self._device.lost(lost["events"], lost["edges"])
        self._device.lost_readings(ReadingKind.IMU, lost["imu"])
        records = self._parts.frame_records
        self._device.lost_readings(ReadingKind.FRAMES, sum(records[len(records) - lost["frames"] :]))

    @property
    def state(self) -> str:
        """The file and how much went there."""
        if self._recorder is not None and self._recorder.broken:
            return "stopped"
        return f"{self._handed['events']} events to {self._order.path.name}"

    @property
    def address(self) -> str | None:
        """The file's path."""
        return str(self._order.path)

    @property
    def trouble(self) -> str:
        """Why the file is not whole."""
        return "" if self._recorder is None else self._recorder.trouble

    @property
    def recording(self) -> RecordingSummary | None:
        """What the file holds, once it is closed."""
        return None if self._recorder is None else self._recorder.summary

    @property
    def counts(self) -> Mapping[str, int]:
        """How many files there are, where the camera's clock started anew."""
        paths = () if self._recorder is None else self._recorder.summary.paths
        return {"files": len(paths)} if len(paths) > 1 else {}
