"""What a coder of a stream is: events and edges in, bytes or datagrams out.

A connection begins with a greeting, and from then on every client gets the same bytes. Datagrams have no beginning:
each stands alone.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import ClassVar

from firmware_protocol.edges import Edges
from firmware_protocol.events import Events
from firmware_protocol.network_streams.picture_settings import PictureSettings

__all__ = ["ConnectionCoder", "Datagram", "DatagramCoder", "StreamFacts"]


@dataclass(frozen=True)
class StreamFacts:
    """What a stream tells of its camera.

    Attributes
    ----------
    size
        (width, height) of the sensor, pixels.
    camera
        Its name, such as "DAVIS346_00000001".
    frame_us
        Stream time of a picture, where the stream is one of pictures.
    compression
        "none" or "lz4", where the format has it.
    pictures
        What pictures show, where the stream is one of pictures.
    """

    size: tuple[int, int]
    camera: str
    frame_us: int = 20_000
    compression: str = "none"
    pictures: PictureSettings = field(default_factory=PictureSettings)


@dataclass(frozen=True)
class Datagram:
    """One datagram, and the number of events of a batch that it ends: those up to `end` have left with it."""

    data: bytes
    end: int


class ConnectionCoder(ABC):
    """Codes a stream for a connection.

    Attributes
    ----------
    limit_px
        Columns and rows that the format can number.
    has_edges
        Whether it carries edges on the camera's external input.
    """

    limit_px: ClassVar[tuple[int, int]]
    has_edges: ClassVar[bool] = False

    def __init__(self, facts: StreamFacts) -> None:
        self.facts = facts

    @property
    @abstractmethod
    def greeting(self) -> bytes:
        """What a client gets first."""

    @abstractmethod
    def encode(self, events: Events, edges: Edges) -> bytes | bytearray:
        """Return whole packets of events (n,) EVENT and edges (m,) EDGE, each sorted, in the camera's own time."""

    def advance(self, t_us: int) -> bytes:
        """Return what is complete because there are no more events before `t_us`."""
        return b""

    def restart(self) -> bytes:
        """Return what tells a client that the camera's clock starts anew; empty where the format has no word for it."""
        return b""

    def finish(self) -> bytes:
        """Return what the coder still holds, at the end."""
        return b""


class DatagramCoder(ABC):
    """Codes a stream for datagrams; see `ConnectionCoder` for the attributes."""

    limit_px: ClassVar[tuple[int, int]]
    has_edges: ClassVar[bool] = False

    def __init__(self, facts: StreamFacts) -> None:
        self.facts = facts

    @abstractmethod
    def encode(self, events: Events, edges: Edges) -> Iterator[Datagram]:
        """Yield datagrams of events (n,) EVENT and edges (m,) EDGE, each sorted, in the camera's own time."""

    def restart(self) -> Iterator[Datagram]:
        """Yield what tells a receiver that the camera's clock starts anew."""
        yield from ()
