"""Link that writes a recording: its parameters, its endpoint, and its registration as a kind of link.

The endpoint passes the device's data to a process that writes the file.
"""

from __future__ import annotations

import asyncio
import dataclasses
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

from firmware_protocol.device.items import Items, Numbers, ReadingKind
from firmware_protocol.device.plain_device import PlainDevice
from firmware_protocol.recordings.part import Facts, counts_of
from transports.link.deliveries import DeliveredParts, Deliveries
from transports.link.endpoint import BUSY_NS, REST_NS, Endpoint, EndpointFactory, EndpointReport
from transports.link.kind import CameraFacts, LinkKind, LinkParameters, Unsuitable, Wiring
from transports.needs import Need, package
from transports.recording.format import Format, format_to_write, with_addition
from transports.recording.live import LiveRecorder
from transports.recording.part import RecordingError


@dataclass(frozen=True)
class FileLink(LinkParameters):
    """A recording of all data that the camera sends and the format can hold, written during the run.

    Attributes
    ----------
    path : the file, relative to the folder of the command, overwritten; its suffix gives the format. NAME-clock2.SUFFIX
        follows after a restart of the camera's clock, NAME-restart1.SUFFIX after one of the link.
    format : name of the format if the suffix does not give it; "" for the suffix. See docs/recordings.md.
    camera : name of the camera in the file; "" for the model's.
    name : name of the link, for reports, faults and triggers.
    """

    kind: ClassVar[str] = "file"
    path: str = ""
    format: str = ""
    camera: str = ""
    name: str = "file"

    def __post_init__(self) -> None:
        if not self.path:
            raise ValueError("path is missing: name a file such as events.aedat4")
        try:
            format_to_write(Path(self.path), self.format)
        except RecordingError as error:
            raise ValueError(str(error)) from error

    def sends_evt(self) -> bool:
        """Return true for a file of EVT words."""
        return format_to_write(Path(self.path), self.format).is_evt

    def needs(self) -> tuple[Need, ...]:
        """Return the package that writes the format."""
        extra = format_to_write(Path(self.path), self.format).needs
        return (package(extra),) if extra else ()


def factory_of(link: FileLink, wiring: Wiring) -> EndpointFactory[Any]:
    """Return the endpoint's factory."""
    form = format_to_write(Path(link.path), link.format)
    camera = link.camera or wiring.camera.model or "evstim"
    facts = Facts(wiring.camera.size, camera, streams=wiring.camera.streams, imu_unit=wiring.camera.imu_unit)
    return FileFactory(Path(link.path), form, facts)


def _check(link: FileLink, camera: CameraFacts) -> None:
    form = format_to_write(Path(link.path), link.format)
    if camera.size[0] > form.size_px[0] or camera.size[1] > form.size_px[1]:
        limit = f"{form.size_px[0]} x {form.size_px[1]}"
        raise Unsuitable(f"{form.title} numbers {limit} pixels, not {camera.size}", "path")


FILE = LinkKind(FileLink, serves="plain", endpoint="transports.file:factory_of", check=_check, has_readings=True)


_MOST_EVENTS = 1 << 16  # passed on at once


@dataclass(frozen=True)
class FileFactory(EndpointFactory[PlainDevice]):
    """Factory of the endpoint, which opens the file in the link's process."""

    path: Path
    form: Format
    facts: Facts

    def build(self, device: PlainDevice, deliveries: Deliveries) -> FileEndpoint:
        """Return the endpoint, which opens the file when it is started."""
        return FileEndpoint(self, device, deliveries)

    def restarted(self, number: int) -> FileFactory:
        """Return the same factory with another file: the data of the killed process stay in the first."""
        return dataclasses.replace(self, path=with_addition(self.path, f"restart{number}"))


class FileEndpoint(Endpoint):
    """Endpoint that passes on the device's data, as fast as the writer accepts them."""

    def __init__(self, order: FileFactory, device: PlainDevice, deliveries: Deliveries) -> None:
        self._order = order
        self._device = device
        self._deliveries = deliveries
        self._parts = DeliveredParts(order.facts.imu_unit)
        self._recorder: LiveRecorder | None = None
        self._epoch_us: int | None = None
        self._handed: Counter[str] = Counter()
        device.is_watched = False  # no receiver notices when data are passed to the writer

    async def start(self) -> None:
        """Start the writer; raises OSError if the file cannot be opened."""
        order = self._order
        self._recorder = await asyncio.to_thread(LiveRecorder, order.path, order.form, order.facts, "file")

    def pump(self) -> None:
        """Pass on the waiting data."""
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

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`; a writer without room is tried again soon."""
        return BUSY_NS if self._device.waiting else REST_NS

    def _hand_over(self, recorder: LiveRecorder, taken: Items) -> None:
        restarted = taken.epoch_us != self._epoch_us
        self._epoch_us = taken.epoch_us
        part = self._parts.part(taken.events, taken.edges, taken.readings, taken.epoch_us)
        if restarted or counts_of(part):
            recorder.append(part, restarted=restarted, unix_us=self._deliveries.unix_us(taken.epoch_us))
        self._deliveries.add(taken.events, taken.epoch_us, taken.edges, taken.readings)
        self._device.sent(taken)
        self._handed.update(counts_of(part))

    async def close(self) -> None:
        """Let the writer finish; data that it could not write are counted as lost on the link."""
        if self._recorder is None:
            return
        await asyncio.to_thread(self._recorder.close)
        self._device.drop_waiting()
        summary = self._recorder.summary
        lost = self._handed - Counter(summary.written) - Counter(summary.left_out)
        records = self._parts.frame_records
        readings = {ReadingKind.IMU: lost["imu"], ReadingKind.FRAMES: sum(records[len(records) - lost["frames"] :])}
        self._device.retract(Numbers(lost["events"], lost["edges"], +Counter(readings)))

    @property
    def state(self) -> str:
        """Name of the file and number of events in it."""
        if self._recorder is not None and self._recorder.broken:
            return "stopped"
        return f"{self._handed['events']} events to {self._order.path.name}"

    def report(self) -> EndpointReport:
        """Return the path of the file, and the summary of the closed file or the reason why it is incomplete."""
        path = str(self._order.path)
        if self._recorder is None:
            return EndpointReport(path)
        return EndpointReport(path, trouble=self._recorder.trouble, recording=self._recorder.summary)

    @property
    def counts(self) -> Mapping[str, int]:
        """Number of files, if the camera's clock was restarted."""
        paths = () if self._recorder is None else self._recorder.summary.paths
        return {"files": len(paths)} if len(paths) > 1 else {}
