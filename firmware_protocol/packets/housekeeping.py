"""The housekeeping report and the time report of an instrument. Big-endian.

    housekeeping, 156 octets
      0  u8   structure id, 1
      1  u8   mode: 0 stopped, 1 streaming
      2  u8   time status: 0 free-running, 1 set by telecommand; 2 synchronised, 3 synchronisation lost: reserved
      3  u8   0
      4  u64  the camera's own time, us: since the start of the stream, or the epoch of the bus once it was set
     12  u32  events per second offered by the sensor since the last report
     16  u32  events per second sent since the last report
     20  i16  temperature, 0.01 degree Celsius
     22  u16  tick, us
     24  4 * u16  region of interest: x, y, width, height, px
     32  u32  rate limit, events per second, 0 none
     36  10 * u64  events since power-on: offered by the sensor, sent, waiting, and dropped because: not running, not
              selected (region, sub-sampling), over the rate limit, too late, buffer full, flushed at a stop, lost on
              the link. The first is the sum of the others.
    116  4 * u64  edges of the external input since power-on: offered, sent, ignored, dropped
    148  u16  telecommands taken          u16  telecommands refused
    152  u16  frames and packets refused  u16  telecommands missing in the count; all four modulo 65 536

    time report, 9 octets
      0  u8   P-field, 0x2F
      1  7    CUC, 4 + 3 octets: time since the epoch of the bus (SetTime), or the start of the stream
      8  u8   time status, as above

The layouts are this instrument's own; services 3 and 9 of ECSS-E-ST-70-41C carry them.
"""

from __future__ import annotations

import struct
from dataclasses import astuple, dataclass
from enum import IntEnum

from firmware_protocol.packets.cuc import CucFormat
from firmware_protocol.packets.errors import PacketError

__all__ = ["EdgeCounts", "EventCounts", "Housekeeping", "LinkCounts", "Mode", "TimeReport", "TimeStatus"]

_STRUCTURE = 1
_HEAD = struct.Struct(">BBBxQIIhH4HI")
_EVENTS = struct.Struct(">10Q")
_EDGES = struct.Struct(">4Q")
_LINK = struct.Struct(">4H")
_SIZE = _HEAD.size + _EVENTS.size + _EDGES.size + _LINK.size
_EVENTS_AT = _HEAD.size
_EDGES_AT = _EVENTS_AT + _EVENTS.size
_LINK_AT = _EDGES_AT + _EDGES.size
_TIME = CucFormat(p_field=True)


class Mode(IntEnum):
    """Whether events flow."""

    STOPPED = 0
    STREAMING = 1


class TimeStatus(IntEnum):
    """What the instrument's time hangs on."""

    FREE_RUNNING = 0
    SET = 1
    SYNCHRONISED = 2
    LOST = 3


@dataclass(frozen=True)
class EventCounts:
    """Events since power-on and their fates, in the order of the wire."""

    offered: int = 0
    sent: int = 0
    waiting: int = 0
    not_running: int = 0
    not_selected: int = 0
    over_rate: int = 0
    too_late: int = 0
    buffer_full: int = 0
    flushed: int = 0
    lost_on_link: int = 0


@dataclass(frozen=True)
class EdgeCounts:
    """Edges since power-on and their fates, in the order of the wire."""

    offered: int = 0
    sent: int = 0
    ignored: int = 0
    dropped: int = 0


@dataclass(frozen=True)
class LinkCounts:
    """What came in on the link, modulo 65 536 on the wire."""

    commands_taken: int = 0
    commands_refused: int = 0
    frames_refused: int = 0
    commands_missing: int = 0


@dataclass(frozen=True)
class Housekeeping:
    """The state of an instrument at one instant.

    Attributes
    ----------
    t_us
        The camera's own time, us.
    offered_hz, sent_hz
        Events per second since the last report.
    temperature_centi_c
        0.01 degree Celsius.
    region
        x, y, width, height in pixels.
    rate_limit_hz
        Events per second, 0 for none.
    """

    t_us: int
    region: tuple[int, int, int, int]
    mode: Mode = Mode.STOPPED
    time_status: TimeStatus = TimeStatus.FREE_RUNNING
    offered_hz: int = 0
    sent_hz: int = 0
    temperature_centi_c: int = 2000
    tick_us: int = 1
    rate_limit_hz: int = 0
    events: EventCounts = EventCounts()
    edges: EdgeCounts = EdgeCounts()
    link: LinkCounts = LinkCounts()

    def encode(self) -> bytes:
        """Return the 156 octets drawn above. Raises ValueError for a number that does not fit."""
        try:
            return b"".join(
                (
                    _HEAD.pack(
                        _STRUCTURE,
                        self.mode,
                        self.time_status,
                        self.t_us,
                        self.offered_hz,
                        self.sent_hz,
                        self.temperature_centi_c,
                        self.tick_us,
                        *self.region,
                        self.rate_limit_hz,
                    ),
                    _EVENTS.pack(*astuple(self.events)),
                    _EDGES.pack(*astuple(self.edges)),
                    _LINK.pack(*(count & 0xFFFF for count in astuple(self.link))),
                )
            )
        except struct.error as error:
            raise ValueError(f"housekeeping: {error}") from error

    @classmethod
    def parse(cls, payload: bytes) -> Housekeeping:
        """Undo `encode`. Raises PacketError for another length, structure, mode or time status."""
        if len(payload) != _SIZE:
            raise PacketError("length")
        structure, mode, status, t_us, offered_hz, sent_hz, temperature, tick_us, *rest = _HEAD.unpack_from(payload)
        x, y, width, height, rate_limit_hz = rest
        if structure != _STRUCTURE or mode not in tuple(Mode) or status not in tuple(TimeStatus) or payload[3]:
            raise PacketError("structure")
        return cls(
            t_us=t_us,
            region=(x, y, width, height),
            mode=Mode(mode),
            time_status=TimeStatus(status),
            offered_hz=offered_hz,
            sent_hz=sent_hz,
            temperature_centi_c=temperature,
            tick_us=tick_us,
            rate_limit_hz=rate_limit_hz,
            events=EventCounts(*_EVENTS.unpack_from(payload, _EVENTS_AT)),
            edges=EdgeCounts(*_EDGES.unpack_from(payload, _EDGES_AT)),
            link=LinkCounts(*_LINK.unpack_from(payload, _LINK_AT)),
        )


@dataclass(frozen=True)
class TimeReport:
    """What time it is for the instrument, in microseconds."""

    t_us: int
    status: TimeStatus = TimeStatus.FREE_RUNNING

    def encode(self) -> bytes:
        """Return the 9 octets drawn above. Raises ValueError for a time that does not fit."""
        return _TIME.encode_us(self.t_us) + bytes([self.status])

    @classmethod
    def parse(cls, payload: bytes) -> TimeReport:
        """Undo `encode`. Raises PacketError for anything that it does not write."""
        if len(payload) != _TIME.octets + 1 or payload[-1] not in tuple(TimeStatus):
            raise PacketError("time report")
        return cls(_TIME.parse_us(payload[:-1]), TimeStatus(payload[-1]))
