"""Telecommands of an instrument and the reports of their execution. Big-endian; `(service, subtype)` as in PUS-C.

    Ping                  (17, 1)     nothing                                     answered by a PONG
    RequestHousekeeping   (3, 27)     u8 1 (structures), u8 1 (structure id)      answered by HOUSEKEEPING
    SetTime               (9, 128)    7  CUC, 4 + 3 octets: time now              answered by a TIME report
    Start                 (128, 1)    nothing                                     events flow
    Stop                  (128, 2)    nothing                                     events stop, waiting ones are dropped
    SetTick               (128, 3)    u16 tick, us: 1, 10, 100 or 1000
    SetRegion             (128, 4)    u16 x, y, width, height, px
    SetRateLimit          (128, 5)    u32 events per second, 0: no limit
    SetBias               (128, 6)    u8 bias number, u16 value

Services 3, 9 and 17 are those of ECSS-E-ST-70-41C (9 has no standard request that sets the time, so its subtype is
from the mission's own range), 128 is private. The device defines its biases and the meaning of their values; for a
DAVIS346 `bias` is the parameter number in module 5 and `value` the register's 16-bit word.

Service 1 of PUS-C reports the result of a telecommand:

    u8   subtype: 1 accepted, 2 not accepted, 3 started, 4 not started, 7 completed, 8 not completed
    u16  packet id of the telecommand          (its first four octets, as received: version, type,
    u16  sequence control of the telecommand    flag, APID, sequence flags and count)
    failures only:
    u16  code, see `FailureCode`
    ...  description of the failure, ASCII, at most 80 characters

In a PUS packet the subtype is that of the packet, and the rest is its source data; in other packets the octets are as
above.

Source: ECSS-E-ST-70-41C, clause 8.1; failure codes 0 to 5 are those of ECSS-E-70-41A, clause 6 (41C leaves them to the
mission), the others are this instrument's own.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import IntEnum
from typing import ClassVar, Self

from firmware_protocol.packets.addresses import PacketError
from firmware_protocol.packets.ccsds import OWN_EPOCH_4_3, SpacePacket
from firmware_protocol.wire_layout import Field, Layout, WrongLength, choices_of

LONGEST_TEXT = 80
"""Most characters of a failure's description."""


class Stage(IntEnum):
    """Stage that a telecommand reached; the value is the subtype of its success, one more that of its failure."""

    ACCEPTANCE = 1
    START = 3
    COMPLETION = 7


class FailureCode(IntEnum):
    """Reason of a telecommand's failure."""

    ILLEGAL_APID = 0
    LENGTH = 1
    CHECKSUM = 2
    ILLEGAL_SERVICE = 3
    ILLEGAL_SUBTYPE = 4
    ILLEGAL_DATA = 5
    NOT_NOW = 6
    NOT_SUPPORTED = 7


REQUEST_LAYOUT = Layout(
    Field("request_packet_id", 16, "version, type, flag and APID of the telecommand, as received"),
    Field("request_sequence_control", 16, "sequence flags and count of the telecommand, as received"),
)
"""Id of the telecommand."""
FAILURE_LAYOUT = Layout(Field("failure_code", 16, "reason of the failure", choices=choices_of(FailureCode)))
"""Reason of the failure; a description follows as text."""


@dataclass(frozen=True)
class Failure:
    """Reason of a failure, as a number for programs and a text for people."""

    code: FailureCode
    text: str = ""


class CommandRefused(ValueError):
    """A telecommand cannot be accepted."""

    def __init__(self, code: FailureCode, text: str) -> None:
        super().__init__(text)
        self.failure = Failure(code, text)


@dataclass(frozen=True)
class RequestId:
    """Id of a telecommand: the first four octets of its packet."""

    packet_id: int
    sequence_control: int

    @property
    def sequence_count(self) -> int:
        """Its sequence count."""
        return self.sequence_control & 0x3FFF

    @classmethod
    def of(cls, packet: SpacePacket) -> RequestId:
        """Return the id of the telecommand in a packet."""
        return cls(packet.packet_id, packet.sequence_control)

    def __bytes__(self) -> bytes:
        return REQUEST_LAYOUT.pack(request_packet_id=self.packet_id, request_sequence_control=self.sequence_control)

    @classmethod
    def parse(cls, octets: bytes) -> RequestId:
        """Read four octets. Raises PacketError for any other number of them."""
        try:
            return cls(*REQUEST_LAYOUT.unpack(octets).values())
        except WrongLength as error:
            raise PacketError("request id") from error


@dataclass(frozen=True)
class Verification:
    """One report: the telecommand passed the stage, or failed there."""

    stage: Stage
    request: RequestId
    failure: Failure | None = None

    @property
    def subtype(self) -> int:
        """Subtype under service 1."""
        return self.stage + (self.failure is not None)

    def encode(self) -> bytes:
        """Return the octets of the layout above."""
        octets = bytes([self.subtype]) + bytes(self.request)
        if self.failure is None:
            return octets
        text = self.failure.text.encode("ascii", "replace")[:LONGEST_TEXT]
        return octets + FAILURE_LAYOUT.pack(failure_code=self.failure.code) + text

    @classmethod
    def parse(cls, payload: bytes) -> Verification:
        """Read the octets of `encode`. Raises PacketError for any others."""
        if not payload or payload[0] not in _SUBTYPES:
            raise PacketError("subtype")
        stage, failed = _SUBTYPES[payload[0]]
        request, notice = RequestId.parse(payload[1:5]), payload[5:]
        if not failed:
            if notice:
                raise PacketError("length")
            return cls(stage, request)
        return cls(stage, request, _parse_failure(notice))


_SUBTYPES = {stage + failed: (stage, bool(failed)) for stage in Stage for failed in (0, 1)}


def _parse_failure(octets: bytes) -> Failure:
    if not FAILURE_LAYOUT.octets <= len(octets) <= FAILURE_LAYOUT.octets + LONGEST_TEXT:
        raise PacketError("length")
    code = FAILURE_LAYOUT.unpack(octets[: FAILURE_LAYOUT.octets])["failure_code"]
    try:
        return Failure(FailureCode(code), octets[FAILURE_LAYOUT.octets :].decode("ascii"))
    except ValueError as error:
        raise PacketError("failure notice") from error


TICKS_US = (1, 10, 100, 1000)


class Telecommand(ABC):
    """One command. The constructor checks the values and raises ValueError."""

    TYPE: ClassVar[tuple[int, int]]
    """Service and subtype."""
    LAYOUT: ClassVar[Layout] = Layout()
    """Fields of the application data."""

    @abstractmethod
    def encode(self) -> bytes:
        """Return the application data."""

    @classmethod
    @abstractmethod
    def parse(cls, data: bytes) -> Self:
        """Read the application data. Raises WrongLength, ValueError for a wrong value."""


@dataclass(frozen=True)
class _FixedLayout(Telecommand):
    """A telecommand whose attributes are the fields of its layout."""

    def __post_init__(self) -> None:
        for field in self.LAYOUT.fields:
            field.check(getattr(self, field.name))

    def encode(self) -> bytes:
        """Return the application data."""
        return self.LAYOUT.pack(**{field.name: getattr(self, field.name) for field in self.LAYOUT.fields})

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read the application data."""
        return cls(**cls.LAYOUT.unpack(data))


@dataclass(frozen=True)
class Ping(_FixedLayout):
    """Request an answer, to test the connection."""

    TYPE = (17, 1)


@dataclass(frozen=True)
class Start(_FixedLayout):
    """Start the flow of events."""

    TYPE = (128, 1)


@dataclass(frozen=True)
class Stop(_FixedLayout):
    """Stop the flow of events."""

    TYPE = (128, 2)


@dataclass(frozen=True)
class SetTick(_FixedLayout):
    """Set the unit of the events' times: ticks of 1, 10, 100 or 1000 us."""

    TYPE = (128, 3)
    LAYOUT = Layout(
        Field("tick_us", 16, "resolution of event times", "us", choices={us: f"US_{us}" for us in TICKS_US})
    )

    tick_us: int

    def __post_init__(self) -> None:
        if self.tick_us not in TICKS_US:
            raise ValueError(f"tick {self.tick_us} us is none of 1, 10, 100, 1000")


@dataclass(frozen=True)
class SetRegion(_FixedLayout):
    """Send only events of a rectangle of pixels."""

    TYPE = (128, 4)
    LAYOUT = Layout(
        Field("x", 16, "left column", "px"),
        Field("y", 16, "top row", "px"),
        Field("width", 16, "columns", "px", lowest=1),
        Field("height", 16, "rows", "px", lowest=1),
    )

    x: int
    y: int
    width: int
    height: int


@dataclass(frozen=True)
class SetRateLimit(_FixedLayout):
    """Limit the events per second; 0 removes the limit."""

    TYPE = (128, 5)
    LAYOUT = Layout(Field("events_per_s", 32, "most events per second; 0 is no limit", "1/s"))

    events_per_s: int


@dataclass(frozen=True)
class SetBias(_FixedLayout):
    """Set one bias of the sensor."""

    TYPE = (128, 6)
    LAYOUT = Layout(Field("bias", 8, "number of the bias"), Field("value", 16, "word of its register"))

    bias: int
    value: int


@dataclass(frozen=True)
class RequestHousekeeping(Telecommand):
    """Send one housekeeping report now."""

    TYPE = (3, 27)
    LAYOUT = Layout(
        Field("structures", 8, "number of structures", fixed=1),
        Field("structure", 8, "number of the housekeeping structure", fixed=1),
    )

    def encode(self) -> bytes:
        """Return the application data: one structure, number 1."""
        return self.LAYOUT.pack()

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read the application data."""
        if not cls.LAYOUT.holds(cls.LAYOUT.unpack(data)):
            raise ValueError("the only housekeeping structure is 1, once")
        return cls()


@dataclass(frozen=True)
class SetTime(Telecommand):
    """Set the time, in microseconds since the epoch of the bus."""

    TYPE = (9, 128)
    LAYOUT = OWN_EPOCH_4_3.layout("now", "time now, since the epoch of the bus")

    t_us: int

    def __post_init__(self) -> None:
        OWN_EPOCH_4_3.encode_us(self.t_us)

    def encode(self) -> bytes:
        """Return the application data."""
        return OWN_EPOCH_4_3.encode_us(self.t_us)

    @classmethod
    def parse(cls, data: bytes) -> Self:
        """Read the application data."""
        cls.LAYOUT.unpack(data)
        return cls(OWN_EPOCH_4_3.parse_us(data))


TELECOMMANDS: dict[tuple[int, int], type[Telecommand]] = {
    kind.TYPE: kind
    for kind in (Ping, RequestHousekeeping, SetTime, Start, Stop, SetTick, SetRegion, SetRateLimit, SetBias)
}


def parse_telecommand(service: int, subtype: int, data: bytes) -> Telecommand:
    """Read one telecommand. Raises CommandRefused, with the code and text of the failure, for anything else."""
    kind = TELECOMMANDS.get((service, subtype))
    if kind is None:
        if any(other_service == service for other_service, _ in TELECOMMANDS):
            raise CommandRefused(FailureCode.ILLEGAL_SUBTYPE, f"service {service} has no subtype {subtype}")
        raise CommandRefused(FailureCode.ILLEGAL_SERVICE, f"no service {service}")
    try:
        return kind.parse(data)
    except WrongLength as error:
        text = f"{kind.__name__}: {len(data)} octets of data is not its length"
        raise CommandRefused(FailureCode.LENGTH, text) from error
    except ValueError as error:
        raise CommandRefused(FailureCode.ILLEGAL_DATA, str(error)) from error
