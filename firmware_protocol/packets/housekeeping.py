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
    148  u16  telecommands accepted      u16  telecommands refused
    152  u16  frames and packets refused  u16  telecommands missing in the count; all four modulo 65 536

    time report, 9 octets
      0  u8   P-field, 0x2F
      1  7    CUC, 4 + 3 octets: time since the epoch of the bus (SetTime), or the start of the stream
      8  u8   time status, as above

The layouts are this instrument's own; services 3 and 9 of ECSS-E-ST-70-41C carry them.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field, fields
from enum import IntEnum
from typing import Any

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import CucFormat
from firmware_protocol.wire_layout import Field, Layout, WrongLength, choices_of

_TIME = CucFormat(p_field=True)


class Mode(IntEnum):
    """State of the flow of events."""

    STOPPED = 0
    STREAMING = 1


class TimeStatus(IntEnum):
    """Source of the instrument's time."""

    FREE_RUNNING = 0
    SET = 1
    SYNCHRONISED = 2
    LOST = 3


def _count(meaning: str) -> Any:
    """Return a field of counts with its meaning."""
    return field(default=0, metadata={"meaning": meaning})


@dataclass(frozen=True)
class EventCounts:
    """Events since power-on and their fates, in the order of the wire."""

    offered: int = _count("offered by the sensor: the sum of the others")
    sent: int = _count("sent")
    waiting: int = _count("waiting in the camera's queue")
    not_running: int = _count("dropped: not running")
    not_selected: int = _count("dropped: outside the region, or left out by sub-sampling")
    over_rate: int = _count("dropped: over the rate limit")
    too_late: int = _count("dropped: waited too long")
    buffer_full: int = _count("dropped: buffer full")
    flushed: int = _count("dropped: flushed at a stop")
    lost_on_link: int = _count("dropped: lost on the link")


@dataclass(frozen=True)
class EdgeCounts:
    """Edges since power-on and their fates, in the order of the wire."""

    offered: int = _count("on the external input")
    sent: int = _count("sent")
    ignored: int = _count("ignored: the detector was off")
    dropped: int = _count("dropped")


@dataclass(frozen=True)
class LinkCounts:
    """Telecommands and frames received on the link, modulo 65 536 on the wire."""

    commands_taken: int = _count("telecommands accepted, modulo 65 536")
    commands_refused: int = _count("telecommands refused, modulo 65 536")
    frames_refused: int = _count("frames and packets refused, modulo 65 536")
    commands_missing: int = _count("telecommands missing in the count, modulo 65 536")


def _counts(kind: type[Any], bits: int, prefix: str = "", subject: str = "", unit: str = "") -> Layout:
    meanings = ((f"{prefix}{count.name}", f"{subject}{count.metadata['meaning']}") for count in fields(kind))
    return Layout(*(Field(name, bits, meaning, unit) for name, meaning in meanings))


_STATUS = Field("time_status", 8, "source of the camera's time", choices=choices_of(TimeStatus))
_HEAD = Layout(
    Field("structure", 8, "number of the housekeeping structure", fixed=1),
    Field("mode", 8, "flow of events", choices=choices_of(Mode)),
    _STATUS,
    Field("reserved", 8, "reserved", fixed=0),
    Field("own_time", 64, "the camera's own time", "us"),
    Field("offered_rate", 32, "events offered by the sensor since the last report", "1/s"),
    Field("sent_rate", 32, "events sent since the last report", "1/s"),
    Field("temperature", 16, "temperature of the sensor", "degC", scale=0.01, signed=True),
    Field("tick", 16, "resolution of event times", "us"),
    Field("region_x", 16, "region of interest: left column", "px"),
    Field("region_y", 16, "region of interest: top row", "px"),
    Field("region_width", 16, "region of interest: width", "px"),
    Field("region_height", 16, "region of interest: height", "px"),
    Field("rate_limit", 32, "most events per second; 0 is no limit", "1/s"),
)
_EVENTS = _counts(EventCounts, 64, "events_", "events since power-on: ", "events")
_EDGES = _counts(EdgeCounts, 64, "edges_", "edges since power-on: ", "edges")
_LINK = _counts(LinkCounts, 16)
HOUSEKEEPING_LAYOUT = _HEAD + _EVENTS + _EDGES + _LINK
"""Layout of the 156 octets above."""
TIME_LAYOUT = _TIME.layout("now", "the camera's own time") + Layout(_STATUS)
"""Layout of the 9 octets above."""


@dataclass(frozen=True)
class Housekeeping:
    """The state of an instrument at one instant.

    Attributes
    ----------
    t_us : the camera's own time, us.
    offered_hz, sent_hz : events per second since the last report.
    temperature_centi_c : 0.01 degree Celsius.
    region : x, y, width, height in pixels.
    rate_limit_hz : events per second, 0 for none.
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
        """Return the 156 octets of the layout above. Raises ValueError for a number that does not fit."""
        x, y, width, height = self.region
        counts = {f"events_{name}": n for name, n in asdict(self.events).items()}
        counts |= {f"edges_{name}": n for name, n in asdict(self.edges).items()}
        counts |= {name: n & 0xFFFF for name, n in asdict(self.link).items()}
        try:
            return HOUSEKEEPING_LAYOUT.pack(
                mode=self.mode,
                time_status=self.time_status,
                own_time=self.t_us,
                offered_rate=self.offered_hz,
                sent_rate=self.sent_hz,
                temperature=self.temperature_centi_c,
                tick=self.tick_us,
                region_x=x,
                region_y=y,
                region_width=width,
                region_height=height,
                rate_limit=self.rate_limit_hz,
                **counts,
            )
        except ValueError as error:
            raise ValueError(f"housekeeping: {error}") from error

    @classmethod
    def parse(cls, payload: bytes) -> Housekeeping:
        """Read the octets of `encode`. Raises PacketError for another length, structure, mode or time status."""
        try:
            values = HOUSEKEEPING_LAYOUT.unpack(payload)
        except WrongLength as error:
            raise PacketError("length") from error
        if not _HEAD.holds(values):
            raise PacketError("structure")
        return cls(
            t_us=values["own_time"],
            region=(values["region_x"], values["region_y"], values["region_width"], values["region_height"]),
            mode=Mode(values["mode"]),
            time_status=TimeStatus(values["time_status"]),
            offered_hz=values["offered_rate"],
            sent_hz=values["sent_rate"],
            temperature_centi_c=values["temperature"],
            tick_us=values["tick"],
            rate_limit_hz=values["rate_limit"],
            events=EventCounts(*(values[count.name] for count in _EVENTS.fields)),
            edges=EdgeCounts(*(values[count.name] for count in _EDGES.fields)),
            link=LinkCounts(*(values[count.name] for count in _LINK.fields)),
        )


@dataclass(frozen=True)
class TimeReport:
    """The instrument's time, in microseconds, and its status."""

    t_us: int
    status: TimeStatus = TimeStatus.FREE_RUNNING

    def encode(self) -> bytes:
        """Return the 9 octets of the layout above. Raises ValueError for a time that does not fit."""
        return _TIME.encode_us(self.t_us) + bytes([self.status])

    @classmethod
    def parse(cls, payload: bytes) -> TimeReport:
        """Read the octets of `encode`. Raises PacketError for any others."""
        if len(payload) != TIME_LAYOUT.octets or payload[-1] not in tuple(TimeStatus):
            raise PacketError("time report")
        return cls(_TIME.parse_us(payload[:-1]), TimeStatus(payload[-1]))
