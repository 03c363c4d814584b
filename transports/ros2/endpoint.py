"""Topics of ROS 2 as a link's endpoint.

    device.take  -> MessageBuffer -> PacketCoder  -> a message a millisecond -> topic of events
                                  -> PictureCoder -> a message a picture     -> topic of pictures

A writer never waits: DDS stores the last `depth` messages, to send them again to readers that missed some. In a run
without pacing, at most half of that number are unacknowledged, so that such a run loses nothing. The run does not wait
for a reader that has acknowledged nothing for two seconds.

`MessageBuffer` holds events until their message is complete; `Window` limits the unacknowledged messages.
"""

from __future__ import annotations

import asyncio
from collections import Counter
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING

import numpy as np

from firmware_protocol.device.items import Items
from firmware_protocol.device.plain_device import PlainDevice, own_time
from firmware_protocol.events import Edges, Events
from firmware_protocol.evt.evt3 import Evt3Encoder
from firmware_protocol.network_streams.pictures import Image as EventImage
from firmware_protocol.network_streams.pictures import chosen, coloured, frames_for
from firmware_protocol.ros2 import EVENT_PACKET, IMAGE, Header, Image, event_packet, image_message, mono_events
from transports.link.deliveries import Deliveries
from transports.link.endpoint import BUSY_NS, REST_NS, Endpoint, EndpointReport
from transports.link.kind import Wiring
from transports.needs import install_command
from transports.ros2.kind import Ros2Link

if TYPE_CHECKING:
    from transports.ros2.dds import DdsParticipant, TopicWriter


class PacketCoder:
    """Encoder of packets of events of a sensor of `size` = (width, height), with the settings of `link`."""

    def __init__(self, link: Ros2Link, size: tuple[int, int]) -> None:
        self._link, self._size = link, size
        self._evt3 = Evt3Encoder(standalone=True, width=self._size[0])
        self._seq = 0

    @property
    def has_edges(self) -> bool:
        """True if edges are part of the messages."""
        return self._link.encoding == "evt3"

    def restart(self) -> None:
        """Restart after a restart of the camera's clock."""
        self._evt3 = Evt3Encoder(standalone=True, width=self._size[0])

    def packet(self, events: Events, edges: Edges, unix_us: int) -> bytes:
        """Return the message of events (n,) EVENT and edges (m,) EDGE, n + m > 0, whose clock was zero at `unix_us`."""
        first_us = min(int(t[0]) for t in (events["t"], edges["t"]) if len(t))
        header = Header((unix_us + first_us) * 1000, self._link.frame_id)
        words, base_ns = (self._evt3.encode(events, edges), 0) if self.has_edges else mono_events(events)
        self._seq += 1
        return event_packet(header, self._size, self._seq - 1, self._link.encoding, words, base_ns)


class PictureCoder:
    """Encoder of pictures of the events of equal stretches of time."""

    def __init__(self, link: Ros2Link, size: tuple[int, int]) -> None:
        self._link, self._size = link, size
        self._frames = frames_for(size, round(link.frame_ms * 1000), link.pictures)

    def restart(self) -> None:
        """Restart after a restart of the camera's clock."""
        self._frames.restart()

    def add(self, events: Events, unix_us: int) -> Iterator[bytes]:
        """Add events (n,) EVENT, whose clock was zero at `unix_us`; yield the messages that they complete."""
        for t_us, image in self._frames.add(events):
            yield self._message(unix_us + t_us, image)

    def advance(self, t_us: int, unix_us: int) -> Iterator[bytes]:
        """Yield the messages that are complete by the camera's time `t_us`."""
        for end_us, image in self._frames.reach(t_us):
            yield self._message(unix_us + end_us, image)

    def _message(self, unix_us: int, image: EventImage) -> bytes:
        header, (width, _) = Header(unix_us * 1000, self._link.frame_id), self._size
        if self._link.image == "display":
            return image_message(
                Image(header, self._size, "rgb8", 3 * width, coloured(image, self._link.pictures).tobytes())
            )
        pixels = np.ascontiguousarray(np.moveaxis(chosen(image, self._link.pictures), 0, 2), "<f4")
        channels = pixels.shape[2]
        return image_message(Image(header, self._size, f"32FC{channels}", 4 * channels * width, pixels.tobytes()))


class MessageBuffer:
    """Buffer that joins a device's data until there are `most_events`, or the first has waited `longest_ns`."""

    def __init__(self, most_events: int, longest_ns: int) -> None:
        self._most, self._longest_ns = most_events, longest_ns
        self._parts: list[Items] = []
        self._since_ns = 0

    @property
    def room(self) -> int:
        """Number of events that still fit."""
        return self._most - sum(len(part.events) for part in self._parts)

    @property
    def holds(self) -> bool:
        """True if any data wait here."""
        return bool(self._parts)

    def add(self, taken: Items, now_ns: int) -> None:
        """Add a part, of the same clock as the earlier parts."""
        if not self._parts:
            self._since_ns = now_ns
        self._parts.append(taken)

    def fits(self, epoch_us: int) -> bool:
        """Return True if a part of a clock that was zero at `epoch_us` may be added."""
        return not self._parts or self._parts[0].epoch_us == epoch_us

    def due(self, now_ns: int) -> bool:
        """Return True if the waiting data are to be sent now."""
        return bool(self._parts) and (self.room <= 0 or now_ns - self._since_ns >= self._longest_ns)

    def taken(self) -> Items | None:
        """Return and remove all waiting data; None if there are none."""
        if not self._parts:
            return None
        parts, self._parts = self._parts, []
        events = np.concatenate([part.events for part in parts])
        edges = np.concatenate([part.edges for part in parts])
        return Items(events, edges, parts[0].epoch_us)


_STALLED_NS = 2_000_000_000


class Window:
    """Limit of `size` messages until all are acknowledged; after two seconds without progress it no longer applies."""

    def __init__(self, size: int) -> None:
        self._size = size
        self._under_way = 0
        self._since_ns: int | None = None
        self._stalled = False

    def written(self) -> None:
        """Count a written message."""
        self._under_way += 1

    def open(self, now_ns: int, acknowledged: Callable[[], bool]) -> bool:
        """Return True if the next message may be written."""
        if self._under_way < self._size and not self._stalled:
            return True
        if acknowledged():
            self._under_way = 0
            self._since_ns = None
            self._stalled = False
            return True
        if self._since_ns is None:
            self._since_ns = now_ns
        self._stalled = now_ns - self._since_ns > _STALLED_NS
        return self._stalled


_MOST_EVENTS = 1 << 14  # in one message
_LINGER_NS = 1_000_000_000
_STEP_S = 0.001


class Ros2Endpoint(Endpoint):
    """Topics of one camera."""

    def __init__(self, link: Ros2Link, wiring: Wiring, device: PlainDevice, deliveries: Deliveries) -> None:
        self._link = link
        self._device = device
        self._deliveries = deliveries
        self._packets = PacketCoder(link, wiring.camera.size)
        self._pictures = PictureCoder(link, wiring.camera.size) if link.image_topic else None
        self._gathering = MessageBuffer(_MOST_EVENTS, round(link.message_ms * 1e6))
        self._participant: DdsParticipant | None = None
        self._events_to: TopicWriter | None = None
        self._pictures_to: TopicWriter | None = None
        self._window = Window(link.depth // 2)
        self._readers = self._epoch_us = 0
        self._zero_us: int | None = None
        self._counts: Counter[str] = Counter()
        device.takes_edges = self._packets.has_edges

    async def start(self) -> None:
        """Join the domain; raises OSError, with the remedy, if that is not possible."""
        try:
            from transports.ros2.dds import DdsParticipant, TopicQos
        except ImportError as error:
            raise OSError(f"topics of ROS 2 need cyclonedds ({error}): {install_command('ros2')}") from error
        link = self._link
        self._device.run(False)
        self._participant = DdsParticipant(link.network)
        qos = TopicQos(link.reliable, link.depth)
        self._events_to = self._participant.writer(link.topic, EVENT_PACKET, qos)
        if link.image_topic:
            self._pictures_to = self._participant.writer(link.image_topic, IMAGE, qos)

    def pump(self) -> None:
        """Publish the due messages."""
        self._count_readers()
        now_ns = self._deliveries.clock.now_ns()
        while self._may_write(now_ns):
            self._gather(now_ns)
            if not self._gathering.due(now_ns):
                break
            self._publish()
        if self._pictures is not None and self._readers and not self._device.waiting and not self._gathering.holds:
            t_us = self._device.now_us - self._epoch_us
            self._show(self._pictures.advance(t_us, self._unix_us))

    @property
    def longest_sleep_ns(self) -> int:
        """Longest time until the next `pump`."""
        return BUSY_NS if self._gathering.holds or self._device.waiting else REST_NS

    async def close(self) -> None:
        """Publish the waiting data, wait a second for slow readers, and leave the domain."""
        if self._events_to is not None and self._participant is not None:
            self._publish()
            clock = self._deliveries.clock
            until_ns = clock.now_ns() + _LINGER_NS
            while not self._acknowledged and clock.now_ns() < until_ns:
                await asyncio.sleep(_STEP_S)
            for writer in self._writers:
                writer.close()
            self._participant.close()
        self._events_to = self._pictures_to = None
        self._device.run(False)

    @property
    def state(self) -> str:
        """Number of readers, or the topics that wait for readers."""
        if not self._readers:
            return f"waiting for a reader of {self._address}"
        return f"{self._readers} reader{'s' if self._readers > 1 else ''} of {self._address}"

    def report(self) -> EndpointReport:
        """Return the names of the topics and their domain, and counts of published messages."""
        return EndpointReport(self._address, counts=+self._counts)

    @property
    def _address(self) -> str:
        topics = [self._link.topic, *([self._link.image_topic] if self._link.image_topic else [])]
        return f"{' and '.join(topics)} in domain {self._link.domain}"

    @property
    def _writers(self) -> list[TopicWriter]:
        return [writer for writer in (self._events_to, self._pictures_to) if writer is not None]

    @property
    def _acknowledged(self) -> bool:
        return all(writer.acknowledged for writer in self._writers)

    @property
    def _unix_us(self) -> int:
        """Unix time of the zero of the camera's clock, from one reading of the wall clock; 0 if there is none (yet)."""
        if self._zero_us is None:
            self._zero_us = self._deliveries.unix_us(self._epoch_us)
        return self._zero_us or 0

    def _count_readers(self) -> None:
        before, self._readers = self._readers, sum(writer.readers for writer in self._writers)
        if bool(before) == bool(self._readers):
            return
        if not self._readers:  # no reader waits for these data
            gone = self._gathering.taken()
            if gone is not None:
                self._device.lost(gone)
            if self._pictures is not None:
                self._pictures.restart()
        self._device.run(bool(self._readers))

    def _may_write(self, now_ns: int) -> bool:
        if not self._readers:
            return False
        if self._deliveries.paced:
            return True
        return self._window.open(now_ns, lambda: self._acknowledged)

    def _gather(self, now_ns: int) -> None:
        while self._gathering.room > 0 and (taken := self._device.take(self._gathering.room)) is not None:
            if not self._gathering.fits(taken.epoch_us):
                self._publish()
            self._gathering.add(taken, now_ns)

    def _publish(self) -> None:
        taken = self._gathering.taken()
        if taken is None or self._events_to is None:
            return
        if taken.epoch_us != self._epoch_us:
            self._epoch_us, self._zero_us = taken.epoch_us, None
            self._packets.restart()
            if self._pictures is not None:
                self._pictures.restart()
        events, edges = own_time(taken.events, taken.epoch_us), own_time(taken.edges, taken.epoch_us)
        if self._packets.has_edges or len(events):
            self._report(taken, self._events_to.write(self._packets.packet(events, edges, self._unix_us)))
        if self._pictures is not None:
            self._show(self._pictures.add(events, self._unix_us))

    def _report(self, taken: Items, written: bool) -> None:
        """Report events whose message DDS has accepted or refused."""
        self._window.written()
        self._counts["messages of events" if written else "messages that DDS refused"] += 1
        if written:
            self._device.sent(taken)
            self._deliveries.add_items(taken)
        else:
            self._device.lost(taken)

    def _show(self, messages: Iterator[bytes]) -> None:
        for message in messages:
            if self._pictures_to is not None and self._pictures_to.write(message):
                self._counts["pictures"] += 1
