"""Messages of a link: packets of events, and pictures of them, each with Unix time."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.evt3.encoding import Evt3Encoder
from firmware_protocol.network_streams.frames import Image as EventImage
from firmware_protocol.network_streams.pictures import chosen, coloured, frames_for
from firmware_protocol.ros2.messages import Header, Image, event_packet, image_message, mono_events
from transports.ros2.parameters import Ros2Topics

__all__ = ["PacketCoder", "PictureCoder"]


class PacketCoder:
    """Codes packets of events of a sensor of `size` = (width, height), as `link` says."""

    def __init__(self, link: Ros2Topics, size: tuple[int, int]) -> None:
        self._link, self._size = link, size
        self._evt3 = Evt3Encoder(standalone=True, width=self._size[0])
        self._seq = 0

    @property
    def has_edges(self) -> bool:
        """Whether edges are part of the messages."""
        return self._link.encoding == "evt3"

    def restart(self) -> None:
        """Begin anew: the camera's clock did."""
        self._evt3 = Evt3Encoder(standalone=True, width=self._size[0])

    def packet(self, events: Events, edges: Edges, unix_us: int) -> bytes:
        """Return the message of events (n,) EVENT and edges (m,) EDGE, n + m > 0, whose clock was zero at `unix_us`."""
        first_us = min(int(t[0]) for t in (events["t"], edges["t"]) if len(t))
        header = Header((unix_us + first_us) * 1000, self._link.frame_id)
        words, base_ns = (self._evt3.encode(events, edges), 0) if self.has_edges else mono_events(events)
        self._seq += 1
        return event_packet(header, self._size, self._seq - 1, self._link.encoding, words, base_ns)


class PictureCoder:
    """Codes pictures of the events of equal stretches of time."""

    def __init__(self, link: Ros2Topics, size: tuple[int, int]) -> None:
        self._link, self._size = link, size
        self._frames = frames_for(size, round(link.frame_ms * 1000), link.pictures)

    def restart(self) -> None:
        """Begin anew: the camera's clock did."""
        self._frames.restart()

    def add(self, events: Events, unix_us: int) -> Iterator[bytes]:
        """Take events (n,) EVENT, whose clock was zero at `unix_us`; yield the messages that these complete."""
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
